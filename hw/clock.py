"""Time as devices see it: injected everywhere, so that nothing but a real bench waits."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Seconds from an arbitrary start, and a way to let them pass."""

    def now(self) -> float: ...
    def sleep(self, seconds: float) -> None: ...


class WallClock:
    """The computer's clock."""

    def now(self) -> float:
        """Seconds on the monotonic clock."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Really wait."""
        time.sleep(max(0.0, seconds))


class VirtualClock:
    """A clock that moves only when somebody waits: for emulated devices and tests."""

    def __init__(self, start: float = 0.0) -> None:
        self._now = start

    def now(self) -> float:
        """Seconds that were waited so far."""
        return self._now

    def sleep(self, seconds: float) -> None:
        """Move on at once."""
        self._now += max(0.0, seconds)
