"""Board and turntable as the rig file wants them: mirrors within their limits, angles of the rig instead of the table.

A `Subscriber` follows what the devices do: simulated cameras see by it that a real turntable turned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hw.base.errors import InputError
from hw.devices.mm_ard import MirrorBoard
from hw.devices.turning import TurntableDriver
from hw.serial.link import Link


class Subscriber:
    """Follows what the devices of a rig do; this one ignores it. No method may raise."""

    def laser(self, index: int, power_mw: float) -> None:
        """A laser emits this power, behind its gate; 0 when it is told to go dark."""

    def mirrors(self, u: int, v: int) -> None:
        """The mirrors stand at these steps."""

    def lines(self, pattern: int) -> None:
        """The TTL lines are these bits."""

    def turntable(self, angle_rad: float) -> None:
        """The turntable stands at this angle of the rig."""


class LimitedBoard(MirrorBoard):
    """A board whose mirrors stay within the limits of the rig file."""

    def __init__(self, link: Link, limits: tuple[tuple[int, int], tuple[int, int]], subscriber: Subscriber) -> None:
        self._limits, self._subscriber = limits, subscriber
        super().__init__(link)

    def set_mirrors(self, u: int, v: int) -> None:
        """Both mirrors.

        Raises: InputError outside the limits, before anything moves.
        """
        for name, value, (low, high) in zip("uv", (u, v), self._limits, strict=True):
            if not low <= value <= high:
                problem, key = "this mirror step is outside the rig's limits", f"board.limits_{name}"
                remedy = "widen the limits in the rig file, or aim the scene's projector so that it needs less"
                raise InputError(problem, key=key, value=value, allowed=f"{low} to {high}", remedy=remedy)
        super().set_mirrors(u, v)
        self._subscriber.mirrors(u, v)

    def set_lines(self, pattern: int) -> None:
        """The TTL lines."""
        super().set_lines(pattern)
        self._subscriber.lines(pattern)

    def darken(self) -> None:
        """Every line low, without waiting for the answer."""
        try:
            super().darken()
        finally:
            self._subscriber.lines(0)


@dataclass
class PlacedTable:
    """A turntable whose own zero and sense of turning differ from the rig's. Angles in rad."""

    table: TurntableDriver
    zero_rad: float
    direction: int
    subscriber: Subscriber

    def __post_init__(self) -> None:
        self.link = self.table.link

    def home(self) -> None:
        """Find the table's zero, and turn to the rig's."""
        self.table.home()
        self.move(0.0)

    def move(self, angle_rad: float) -> None:
        """Turn to an angle of the rig."""
        self.table.move(self.zero_rad + self.direction * angle_rad)
        self.subscriber.turntable(angle_rad)

    def angle_rad(self) -> float:
        """Where it stands."""
        return self.direction * (self.table.angle_rad() - self.zero_rad) % (2 * np.pi)

    def close(self) -> None:
        """Stop, and give the port back."""
        self.table.close()
