"""Emulated devices: what they do (pure state machines with an injected clock), their lines, the bench they stand on."""
