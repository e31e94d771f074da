"""The rig as an interface, the raw record, and real devices."""
