"""Signals that end a program, so that none of them ends it before its rig is safe.

Python handles Ctrl-C alone: at SIGTERM, SIGHUP and SIGQUIT it would end without a `finally`, gates open and lamps lit.
Here all four are treated alike. Signals that the program ignores (nohup) stay ignored; outside the main thread Python
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


@dataclass(eq=False)
class Interruption:
    """`stopped`: the program was asked to end. Once `ignoring`, nothing interrupts any more."""

    stopped: bool = False
    ignoring: bool = False

    def handle(self, number: int, frame: FrameType | None) -> None:
        """The first signal interrupts; nothing interrupts the ending that follows."""
        if not self.ignoring:
            self.ignoring = self.stopped = True
            _program.over = _program.ends
            raise KeyboardInterrupt


@dataclass
class _Program:
    """`ends`: with the first interrupted block. `over`: it was interrupted; signals are ignored after that block."""

    ends: bool = False
    over: bool = False


_program = _Program()
_obeyed: list[Interruption] = []  # of the blocks that the program is in


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """A block in which the first ending signal, whichever it is, is a KeyboardInterrupt; later ones are ignored."""
    interruption = Interruption()
    caught: list[KeyboardInterrupt] = []
    try:
        with _handled_by(interruption.handle, caught):
            if caught:
                raise caught[0]
            _obeyed.append(interruption)
            yield interruption
    finally:
        if interruption in _obeyed:
            _obeyed.remove(interruption)
        if caught:
            raise caught[0]


def exit_on_first_signal() -> None:
    """Let the first `interruptible` block that is interrupted end the program.

    All later signals are ignored until it has ended, also while Python shuts down and its handlers are gone: the exit
    status is that of the first signal, after everything was made safe. A script does not call this: it may go on, and
    be interrupted again.
    """
    _program.ends = True


def raise_if_interrupted() -> None:
    """Interrupt once more where that was lost: Python swallows what is raised in a `__del__` or a weakref's callback.

    To be called before each thing that takes long or lets light out.
    """
    if threading.current_thread() is threading.main_thread() and any(block.stopped for block in _obeyed):
        raise KeyboardInterrupt


@contextmanager
def uninterrupted() -> Iterator[None]:
    """A block that no ending signal interrupts; one that arrives in it counts at its end."""
    seen: list[int] = []
    caught: list[KeyboardInterrupt] = []
    try:
        with _handled_by(lambda number, frame: seen.append(number), caught):
            yield
    finally:
        for number in seen:
            signal.raise_signal(number)
        if caught:
            raise caught[0]


@contextmanager
def _handled_by(handle: Callable[[int, FrameType | None], None], caught: list[KeyboardInterrupt]) -> Iterator[None]:
    """Replace the handlers, and put them back. What interrupts either is kept in `caught` until all of them are."""
    before: dict[int, Callable[[int, FrameType | None], object] | int] = {}

    def replace() -> None:
        for number in sorted(ENDING, key=lambda n: n != signal.SIGINT):  # Ctrl-C, which comes twice, first
            found = signal.getsignal(number)
            if found not in (signal.SIG_IGN, None):
                before.setdefault(number, found)
                signal.signal(number, handle)

    def restore() -> None:
        for number in reversed(before):  # and last
            signal.signal(number, signal.SIG_IGN if _program.over else before[number])

    try:
        if threading.current_thread() is threading.main_thread():
            _insist(replace, caught)
        yield
    finally:
        _insist(restore, caught)


def _insist(step: Callable[[], None], caught: list[KeyboardInterrupt]) -> None:
    """Take a step that may be taken twice, again after what interrupts it."""
    while True:
        try:
            return step()
        except KeyboardInterrupt as error:
            caught.append(error)
