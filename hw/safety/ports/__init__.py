"""Ports that the supervisor lends, in pyserial's language: `supervised://KIND:PORT` (`protocol_supervised`)."""
