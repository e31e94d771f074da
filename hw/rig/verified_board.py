"""The mirror board as far as it can be trusted: where its lines and mirrors are, and when that is not certain.

A board that is reset forgets where the mirrors stand, and works again at once: images would show the wrong place with
the right power. A line that is high as long as the rig is on is the witness that this has not happened.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import TypeVar

from hw.base.clock import Clock
from hw.base.errors import DeviceFault, NoAnswer
from hw.rig.drivers import HEARD_S, Board

log = logging.getLogger(__name__)

T = TypeVar("T")

ATTEMPTS = 3
PROMPT_S = 0.15  # answers take a few milliseconds on an idle computer; a repeated question takes 200 or more
SETTLE_S = 0.005  # of the galvos, after the DAC has taken both values


class VerifiedBoard:
    """A board whose lines are all low, the commands that it gets from then on, and whether it still obeys them.

    darken: commands every light to go out, without waiting for an answer
    """

    def __init__(self, board: Board, clock: Clock, gate_lines: Sequence[int], darken: Callable[[], None]) -> None:
        self.board, self._clock, self._darken = board, clock, darken
        self._gates = sum(1 << line for line in gate_lines)
        self._pattern = 0
        self._opening = False  # a gate is just being opened
        self._aim, self._aimed = (0, 0), False  # where the mirrors were sent; whether that is certain
        self.distrusted = False  # an answer was lost while a gate was open, and the lasers were commanded off
        board.when_lost(self._lost)

    def _lost(self) -> None:
        """An answer was lost: no light while that is found out, and no opening is repeated."""
        if self._opening:
            self.board.darken()
            self._clock.sleep(HEARD_S)
            raise NoAnswer("board", "the mirror board", "did not confirm an open gate", "check its cable")
        if self._pattern & self._gates:
            self.distrusted = True
            self._darken()

    def ask(self, question: Callable[[Board], T]) -> T:
        """Use the board. Where a command had to be repeated, the mirrors are not trusted any more.

        A board that is reset forgets where the mirrors stand, and its armed line falls until lines are set again: a
        reset is seen by that line (`require_lines`), or by an answer that did not come at once.
        """
        begun = self._clock.now()
        answer = question(self.board)
        if self._clock.now() - begun > PROMPT_S:
            log.info("the mirror board was slow to answer: the mirrors will be aimed anew")
            self._aimed = False
        return answer

    def counts(self, pin: int) -> int:
        """The converter's value at a pin; refused where the light went out meanwhile."""
        counts = self.ask(lambda board: board.counts(pin))
        self._require_trust()
        return counts

    # ---- TTL lines

    def lit(self, line: int) -> bool:
        """Whether a line is switched on, or may be."""
        return bool(self._pattern >> line & 1)

    def switch(self, line: int, on: bool) -> None:
        """One line, the others as they are. A line that may have been switched counts as on."""
        before = self._pattern
        after = before | 1 << line if on else before & ~(1 << line)
        self._pattern = before | after
        self.ask(lambda board: board.set_lines(after))
        self._pattern = after

    def require_lines(self) -> None:
        """Refuse an image during which the board was reset: gates and mirrors have moved. Raises: DeviceFault."""
        found = self.ask(lambda board: board.lines())
        self._require_trust()  # it was we who shut them
        if found != self._pattern:
            problem = f"has its TTL lines at {found:06b} instead of {self._pattern:06b}: it was reset"
            raise DeviceFault("board", "the mirror board", problem, "check its power supply, then repeat the command")

    def _require_trust(self) -> None:
        if self.distrusted:
            problem = "lost an answer while a gate was open: the lasers were switched off"
            raise DeviceFault("board", "the mirror board", problem, "check its cable, then repeat the command")

    def open_gate(self, line: int) -> None:
        """Open a gate, being certain that the mirrors stand where they were sent. Raises: DeviceFault."""
        self._require_trust()
        for _ in range(ATTEMPTS):
            if not self._aimed:
                self.aim(*self._aim)
            self.require_lines()
            if self._try_open(line) and self._aimed:
                return
            self._aimed = False
            self.switch(line, False)
        raise self._slow("open a gate")

    def _try_open(self, line: int) -> bool:
        """Once: where the answer is lost the board may have been reset, its mirrors anywhere, so it is not repeated."""
        self._opening = True
        try:
            self.switch(line, True)
        except NoAnswer as error:
            log.warning("%s; shutting it and aiming anew", error.without_remedy)
            return False
        finally:
            self._opening = False
        return True

    # ---- mirrors

    def aim(self, u: int, v: int) -> None:
        """Mirror steps; returns when the mirrors have settled. Raises: DeviceFault."""
        self._aim = (u, v)
        for _ in range(ATTEMPTS):
            self._aimed = True
            self.ask(lambda board: board.set_mirrors(u, v))
            if self._aimed:
                self._clock.sleep(SETTLE_S)
                return
        raise self._slow("aim its mirrors")

    def _slow(self, what: str) -> DeviceFault:
        problem = f"did not {what} promptly in {ATTEMPTS} attempts"
        return DeviceFault("board", "the mirror board", problem, "check its cable and power supply")
