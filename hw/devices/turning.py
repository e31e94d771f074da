"""What the turntables have in common: degrees of a full turn, and the words for not arriving."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from hw.base.errors import NoAnswer
from hw.serial.link import Link

POLL_S = 0.1
BLOCKED = "check that nothing blocks the table, then home it again"


class TurntableDriver(Protocol):
    """A turntable's driver: it satisfies `hw.interface.Turntable` and finds its zero."""

    link: Link

    def home(self) -> None:
        """Find the zero again: after power-on, a power cut or a stall."""

    def move(self, angle_rad: float) -> None:
        """Turn to an angle; returns when the table stands still there."""

    def angle_rad(self) -> float:
        """Where it stands, 0 .. 2 pi."""

    def close(self) -> None:
        """Stop as far as the table can, and give the port back."""


def degrees_of(angle_rad: float) -> float:
    """The angle within one turn, in degrees."""
    return float(np.rad2deg(angle_rad)) % 360.0


def not_reached(link: Link, angle_deg: float, limit_s: float, where: str) -> NoAnswer:
    """The error of a turntable that did not arrive in time."""
    problem = f"did not reach {angle_deg:.1f} deg in {limit_s:g} s ({where})"
    return link.error(NoAnswer, problem, BLOCKED)
