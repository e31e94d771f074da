"""Drives a rig through a plan into a stream, and judges what was captured."""
