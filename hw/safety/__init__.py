"""Light goes out when a program ends: the supervisor, which owns the ports of board and lasers; ending signals."""
