"""Ports that are no hardware, in pyserial's language: `memory://NAME` (see `protocol_memory`)."""
