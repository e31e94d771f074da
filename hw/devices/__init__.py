"""Drivers of real devices: each speaks one protocol and refuses every other device (docs/howto/write-a-driver.md)."""
