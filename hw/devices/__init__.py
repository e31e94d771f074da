"""Drivers of real devices: each speaks one protocol, refuses every other device, and names the remedy in its errors."""
