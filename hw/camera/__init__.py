"""Cameras of a real rig: exposure bracketing, GenICam cameras and their grabber."""
