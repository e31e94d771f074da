"""Scores against truth and references, the error budget, the simulation's noise, summary.json."""
