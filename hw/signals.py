"""Signals that end a program, so that none of them ends it before its rig is safe.

Python knows Ctrl-C alone: at SIGTERM, SIGHUP and SIGQUIT it would end without a `finally`, gates open and lamps lit.
Here all four are one thing. Signals that the program ignores (nohup) stay ignored; outside the main thread Python
delivers none, and nothing here does anything.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

ENDING = frozenset({signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT})


@dataclass
class Interruption:
    """`stopped`: the program was told to end. Once `ignoring`, nothing interrupts any more."""

    stopped: bool = False
    ignoring: bool = False

    def handle(self, number: int, frame: FrameType | None) -> None:
        """The first one interrupts; what follows is the end, and nothing interrupts that."""
        if not self.ignoring:
            self.ignoring = self.stopped = True
            raise KeyboardInterrupt


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """A block in which the first ending signal, whichever it is, is a KeyboardInterrupt, and the others are nothing."""
    interruption = Interruption()
    with _handled_by(interruption.handle):
        yield interruption


@contextmanager
def uninterrupted() -> Iterator[None]:
    """A block that no ending signal interrupts; one that arrives in it counts at its end."""
    seen: list[int] = []
    try:
        with _handled_by(lambda number, frame: seen.append(number)):
            yield
    finally:
        for number in seen:
            signal.raise_signal(number)


@contextmanager
def _handled_by(handle: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in ENDING:
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                before[number] = signal.signal(number, handle)
    try:
        yield
    finally:
        for number in sorted(before, key=lambda n: n == signal.SIGINT):  # Ctrl-C, which comes twice, last
            signal.signal(number, before[number])
