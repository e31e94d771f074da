"""A turning stage's motion, whatever its protocol: `Spindle`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

SPEED_DEG_S = 45.0
SETTLE_S = 0.3


def approach(start: float, target: float, way: float) -> float:
    """Where something stands that has gone `way` from `start` towards `target`, and no farther than that."""
    left = target - start
    return target if abs(left) <= way else start + (way if left > 0 else -way)


@dataclass
class Spindle:
    """Turns at a constant speed, then settles. Angles in degrees, unbounded; `homed` after finding its zero.

    `sticks_at_deg`: the next move that comes by stalls there. `on_move` is called with every angle that it is sent to.
    A power cut loses the reference.
    """

    angle_deg: float = 0.0
    homed: bool = False
    stalled: bool = False
    sticks_at_deg: float | None = None
    on_move: Callable[[float], None] = lambda angle_deg: None
    _since: float = 0.0
    _busy_until: float = 0.0
    _homing: bool = False

    def __post_init__(self) -> None:
        self._start = self.angle_deg

    def position(self, now: float) -> float:
        """Degrees."""
        return approach(self._start, self.angle_deg, max(0.0, now - self._since) * SPEED_DEG_S)

    def busy(self, now: float) -> bool:
        """Whether it still moves or settles."""
        if self._homing and now >= self._busy_until:
            self._homing, self.homed = False, True
        return now < self._busy_until

    def go(self, angle_deg: float, now: float, homing: bool = False) -> float:
        """Start a move; the seconds that it takes."""
        self._start, self._since = self.position(now), now
        self.stalled = False
        stuck = self.sticks_at_deg
        if stuck is not None and min(self._start, angle_deg) <= stuck <= max(self._start, angle_deg):
            angle_deg, self.stalled, self.homed, self.sticks_at_deg = stuck, True, False, None
        self.angle_deg, self._homing = angle_deg, homing and not self.stalled
        duration = abs(angle_deg - self._start) / SPEED_DEG_S + SETTLE_S
        self._busy_until = now + duration
        self.on_move(angle_deg)
        return duration

    def stop(self, now: float) -> None:
        """Stand still."""
        self.angle_deg = self._start = self.position(now)
        self._busy_until, self._homing = now, False

    def power_cycle(self, now: float) -> None:
        """The stage stops where it is, and its reference is lost."""
        self.stop(now)
        self.homed = self.stalled = False
