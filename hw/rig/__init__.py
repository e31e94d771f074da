"""The rig of real devices: the rig file and its rules, connection, limits, self-test, and the rig as an interface."""
