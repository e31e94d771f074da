"""Fixtures that several modules share."""

from guard_fakes import laser, lasers, link, ports, run
from reconstruct_synthetic import small
from refusals import says
from rig_programs import devices

__all__ = ["devices", "laser", "lasers", "link", "ports", "run", "says", "small"]
