"""What keeps lasers off when a program ends: signals, and guard processes that own the lasers' ports."""
