"""Links to serial devices: opening, framing, waiting, questions and answers, and the log of every byte."""
