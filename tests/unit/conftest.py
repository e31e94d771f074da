"""Fixtures that several modules share."""

from guard_fakes import laser, lasers, link, ports, run

__all__ = ["laser", "lasers", "link", "ports", "run"]
