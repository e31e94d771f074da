"""Ports that belong to a guard process, in pyserial's language: `guard://PORT` (see `protocol_guard`)."""
