"""Drivers of real devices: each knows one protocol, refuses every other device, and speaks of the rig in its errors."""
