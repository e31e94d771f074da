"""The twin behind the rig's interface, and emulated devices on ports."""
