"""The rig as an interface, the raw record, and real devices; a laboratory can use it alone (docs/lab.md)."""
