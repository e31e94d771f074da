"""Questions, one at a time, to a device that speaks in lines without number or checksum."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

from hw.serial.link import Inbox, LineFramer, Link, asked

T = TypeVar("T")

RESYNC_S = 3.0  # for the answer that brings both sides back into step


class Dialogue:
    """Asks, and waits for the answer that is wanted.

    After a lost answer the device is asked for its identity: answers come in order, so that what comes before that
    answer is old. identity: that command, and whether a line answers it; quiet_s: so long nothing comes before
    """

    def __init__(
        self, link: Link, ending: str, identity: tuple[str, Callable[[str], bool]], quiet_s: float = 0.5
    ) -> None:
        self.link, self._ending, self._identity, self._quiet_s = link, ending, identity, quiet_s
        self._inbox: Inbox[str] = Inbox(link, LineFramer())
        self._owed = False  # an answer that was not waited for may still come

    def once(self, command: str, wanted: Callable[[str], bool], timeout_s: float) -> str:
        """The answer.

        Raises: NoAnswer; the command may have been obeyed nevertheless.
        """
        if self._owed:
            self._resynchronise()
        self._inbox.clear()
        self._send(command)
        line = self._inbox.next(wanted, timeout_s)
        self._owed = line is None
        if line is None:
            raise self.link.no_answer(repr(command), timeout_s)
        return line

    def ask(self, command: str, wanted: Callable[[str], bool], timeout_s: float, parse: Callable[[str], T]) -> T:
        """The parsed answer to what may be asked twice.

        Raises: NoAnswer; Garbled where no answer can be parsed (ValueError).
        """
        once = partial(self.once, command, wanted, timeout_s)
        return asked(self.link, repr(command), once, parse, self._resynchronise)

    def _resynchronise(self) -> None:
        """No older answer can come any more after this."""
        self._inbox.drain(self._quiet_s)
        command, answers = self._identity
        self._send(command)
        self._owed = self._inbox.next(answers, RESYNC_S) is None

    def _send(self, command: str) -> None:
        self.link.write((command + self._ending).encode("ascii"))
