"""Cameras, projector, meshes, rays and the boundary's transmittance: what a rig and an object are, in mm."""
