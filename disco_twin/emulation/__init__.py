"""The simulated rig: behind the rig's interface, and as emulated devices that real drivers reach through ports."""
