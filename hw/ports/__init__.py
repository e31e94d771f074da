"""Ports that are no hardware, in pyserial's language: `memory://NAME` (see `hw.ports.protocol_memory`)."""
