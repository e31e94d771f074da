"""Fixtures that several modules share."""

from refusals import says

__all__ = ["says"]
