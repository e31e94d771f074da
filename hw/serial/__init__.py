"""Links to serial devices: opening, framing, waiting, and the log of every byte."""
