"""The rig of real devices: what is connected where, its limits, and the capture interface in front of it."""
