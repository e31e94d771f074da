"""Fixtures that several modules share."""

from reconstruct_synthetic import small
from refusals import says
from rig_programs import devices
from supervisor_fakes import laser, lasers, link, ports, run

__all__ = ["devices", "laser", "lasers", "link", "ports", "run", "says", "small"]
