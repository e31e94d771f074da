"""Fixtures that several modules share."""

from guard_fakes import laser, lasers, link, ports, run
from reconstruct_synthetic import small
from refusals import says

__all__ = ["laser", "lasers", "link", "ports", "run", "says", "small"]
