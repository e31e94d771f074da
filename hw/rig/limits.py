"""Board and turntable as the rig file wants them: mirrors within their limits, angles of the rig instead of the table.

What the devices of a rig do is also told to a `Subscriber`: simulated cameras see by it that a real turntable turned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hw.base.errors import InputError
from hw.devices.turning import TurntableDriver
from hw.rig.drivers import Board


class Subscriber:
    """Is told what the devices of a rig do; this one ignores it. No method may raise."""

    def laser(self, index: int, power_mw: float) -> None:
        """A laser emits this power, behind its gate; 0 when it is told to go dark."""

    def mirrors(self, u: int, v: int) -> None:
        """The mirrors stand at these steps."""

    def lines(self, pattern: int) -> None:
        """The TTL lines are these bits."""

    def turntable(self, angle_rad: float) -> None:
        """The turntable stands at this angle of the rig."""


@dataclass
class LimitedBoard:
    """A board whose mirrors stay within the limits of the rig file."""

    board: Board
    limits: tuple[tuple[int, int], tuple[int, int]]
    subscriber: Subscriber

    def when_lost(self, action: Callable[[], None]) -> None:
        """What to do when an answer was lost, before anything is repeated."""
        self.board.when_lost(action)

    def set_mirrors(self, u: int, v: int) -> None:
        """Both mirrors.

        Raises: InputError outside the limits, before anything moves.
        """
        for name, value, (low, high) in zip("uv", (u, v), self.limits, strict=True):
            if not low <= value <= high:
                raise InputError(
                    "this mirror step is outside the rig's limits",
                    key=f"board.limits_{name}",
                    value=value,
                    allowed=f"{low} to {high}",
                    remedy="widen the limits in the rig file, or aim the scene's projector so that it needs less",
                )
        self.board.set_mirrors(u, v)
        self.subscriber.mirrors(u, v)

    def set_lines(self, pattern: int) -> None:
        """The TTL lines."""
        self.board.set_lines(pattern)
        self.subscriber.lines(pattern)

    def lines(self) -> int:
        """The TTL lines as they are."""
        return self.board.lines()

    def darken(self) -> None:
        """Every line low, without waiting for the answer."""
        self._low(self.board.darken)

    def shut(self) -> None:
        """Every line low."""
        self._low(self.board.shut)

    def counts(self, pin: int) -> int:
        """The converter's value at a pin."""
        return self.board.counts(pin)

    def close(self) -> None:
        """Shut, and give the port back."""
        self._low(self.board.close)

    def _low(self, act: Callable[[], None]) -> None:
        try:
            act()
        finally:
            self.subscriber.lines(0)


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
