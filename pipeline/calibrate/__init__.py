"""Poses, lenses, projector and photometry of a captured rig, from its own images."""
