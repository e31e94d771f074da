"""Emulated devices: what they do (pure state machines with an injected clock), and the cables they hang on."""
