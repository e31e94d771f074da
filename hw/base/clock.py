"""Time as devices see it: injected everywhere, so that nothing but a real bench waits."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
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


def side_by_side(clock: Clock, steps: Sequence[Callable[[], None]]) -> None:
    """Take steps that wait, and do not raise, at the same time: all of them take no longer than the longest.

    One after the other on a virtual clock, where no wait takes any time and one would count as every other's.
    """
    here, threads = list(steps), []
    if not isinstance(clock, VirtualClock):
        here, others = here[:1], here[1:]
        for step in others:
            thread = threading.Thread(target=step)
            try:
                thread.start()
            except RuntimeError:  # the system gives no thread any more: then in this one
                here.append(step)
            else:
                threads.append(thread)
    for step in here:
        step()
    for thread in threads:
        thread.join()


class Timebase(Protocol):
    """The clock that the capture's record is written by."""

    def restart(self) -> None:
        """The rig is ready: this is time 0."""

    def now(self) -> float: ...
    def resume_at(self, time_s: float) -> None: ...


class Elapsed:
    """Seconds on a clock since the rig was ready; an interrupted capture goes on from its last image's time."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._start = clock, clock.now()

    def restart(self) -> None:
        """Time 0 is now."""
        self._start = self._clock.now()

    def now(self) -> float:
        """Seconds since then."""
        return self._clock.now() - self._start

    def resume_at(self, time_s: float) -> None:
        """Now is `time_s`."""
        self._start = self._clock.now() - time_s
