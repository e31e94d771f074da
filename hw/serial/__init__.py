"""The line to a serial device: opening, framing, waiting, and the log of every byte."""
