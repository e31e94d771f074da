"""Scores against truth and references, what an error budget compares with, the simulation's noise, summary.json."""
