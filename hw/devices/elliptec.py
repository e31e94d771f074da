"""Thorlabs Elliptec rotation stages (ELL14): 9600 baud, one hex digit of address and two letters a command.

The answer to a move comes when the motion has ended; `GS` with a code comes instead of it when something is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from hw.base.errors import DeviceFault, NoAnswer
from hw.devices.turning import BLOCKED, POLL_S, degrees_of, not_reached
from hw.serial.dialogue import Dialogue
from hw.serial.link import Link

T = TypeVar("T")

BAUD = 9600
ANSWER_S = 0.5
HOME_S = 20.0
PATIENCE_S = 5.0  # most moves have ended by then
QUIET_S = 0.3
ROTARY = {0x0E: "ELL14", 0x12: "ELL18"}
OK, BUSY = 0, 9
CODES = {
    1: "a communication time-out",
    2: "a mechanical time-out",
    3: "an unknown command",
    4: "a value out of range",
    5: "its module isolated",
    6: "its module out of isolation",
    7: "an initialisation error",
    8: "a thermal error",
    9: "busy",
    10: "a sensor error",
    11: "a motor error",
    12: "a position out of range",
    13: "an over-current",
}


class ElliptecTable:
    """A rotary stage on a bus of up to 16; `address` is 0 unless it was changed."""

    def __init__(self, link: Link, address: int = 0, reach_s: float = 20.0) -> None:
        self.link, self.reach_s = link, reach_s
        self._address = f"{address:X}"
        self._dialogue = Dialogue(link, "", (f"{self._address}in", lambda m: m[:3] == self._address + "IN"), QUIET_S)
        self.model, self.serial_number, self._pulses = self._identify()

    # ---- talking

    def _answers(self, expected: str) -> Callable[[str], bool]:
        """Whether a line is the `expected` answer, or a `GS`."""
        wanted = {self._address + expected, self._address + "GS"}
        return lambda line: line[:3] in wanted

    def _ask(self, command: str, expected: str, parse: Callable[[str], T]) -> T:
        """The answer from its letters on."""
        wanted = self._answers(expected)
        return self._dialogue.ask(self._address + command, wanted, ANSWER_S, lambda line: parse(line[1:]))

    # ---- identity

    def _identify(self) -> tuple[str, str, int]:
        try:
            answer = self._ask("in", "IN", str)
        except NoAnswer as error:
            problem = f"is not an Elliptec stage: asked {self._address}in, {self.link.heard()}"
            raise self.link.wrong_device(problem) from error
        try:
            kind, serial, travel, pulses = int(answer[2:4], 16), answer[4:12], int(answer[20:24], 16), answer[24:32]
            steps = int(pulses, 16)
        except ValueError as error:
            raise self.link.wrong_device(f"is not an Elliptec stage: it answered {answer[:40]!r}") from error
        if kind not in ROTARY or travel != 360:
            raise self.link.wrong_device(f"is not a rotation stage: an ELL{kind} with a travel of {travel} answered")
        return ROTARY[kind], serial, steps

    # ---- moving

    def home(self) -> None:
        """Find the zero (clockwise)."""
        self._go("ho0", 0.0, 0, HOME_S)

    def move(self, angle_rad: float) -> None:
        """Turn to an angle; returns when the table stands still there. Raises: DeviceFault, NoAnswer."""
        angle = degrees_of(angle_rad)
        target = round(angle / 360.0 * self._pulses)
        self._go(f"ma{target:08X}", angle, target, self.reach_s)

    def _go(self, command: str, angle_deg: float, target: int, limit_s: float) -> None:
        """Move and compare the place; once more if it is another: a command may be lost, and repeating it is safe."""
        end = self.link.clock.now() + limit_s
        for _ in range(2):
            self._turn(command, angle_deg, end, limit_s)
            found = self._position()
            away = (found - target + self._pulses // 2) % self._pulses - self._pulses // 2
            if abs(away) <= max(2, round(self._pulses / 3600)):  # 0.1 deg: what the stage repeats to
                return
        problem = f"stopped at {found / self._pulses * 360.0:.2f} deg instead of {angle_deg:.2f} deg"
        raise self.link.error(DeviceFault, problem, BLOCKED)

    def _turn(self, command: str, angle_deg: float, end: float, limit_s: float) -> None:
        """Start, and wait for the answer at the end of the motion; if it does not come, ask."""
        clock = self.link.clock
        try:
            limit = min(limit_s, PATIENCE_S)
            self._check(self._dialogue.once(self._address + command, self._answers("PO"), limit)[1:])
        except NoAnswer:
            while (code := self._ask("gs", "GS", _code)) == BUSY:
                if clock.now() > end:
                    raise not_reached(self.link, angle_deg, limit_s, "it is still turning") from None
                clock.sleep(POLL_S)
            self._check(f"GS{code:02X}")

    def _check(self, answer: str) -> None:
        if answer.startswith("GS") and answer != "GS00":
            code = _code(answer)
            problem = f"reports {CODES.get(code, f'error {code}')}"
            raise self.link.error(DeviceFault, problem, BLOCKED)

    def _position(self) -> int:
        """Pulses from zero, signed."""

        def pulses(answer: str) -> int:
            if not answer.startswith("PO") or len(answer) != 10:
                raise ValueError(answer)
            value = int(answer[2:], 16)
            return value - (1 << 32) if value >> 31 else value

        return self._ask("gp", "PO", pulses)

    def angle_rad(self) -> float:
        """Where it stands, 0 .. 2 pi."""
        return float(2.0 * np.pi * (self._position() / self._pulses % 1.0))

    def close(self) -> None:
        """Give the port back; a move that has begun goes on, since nothing stops the stage: a second or two."""
        self.link.close()


def _code(answer: str) -> int:
    if not answer.startswith("GS") or len(answer) != 4:
        raise ValueError(answer)
    return int(answer[2:], 16)
