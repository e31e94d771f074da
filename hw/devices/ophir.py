"""Ophir power meters (Vega, Nova II) over RS-232, 9600 baud: `$..` CR LF is answered by `*...` or `?...`, CR LF.

Answers have neither number nor checksum: after a lost one the meter is asked who it is, and what comes before that
answer is old.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import partial
from typing import TypeVar

from hw.base.errors import DeviceFault, DeviceRefused, NoAnswer
from hw.serial.link import Inbox, LineFramer, Link, asked

T = TypeVar("T")

BAUD = 9600
ANSWER_S = 1.0
QUIET_S = 0.5
RESYNC_S = 3.0
METERS = ("VEGA", "NOVAII", "NOVA2", "LASERSTAR")
POWER = re.compile(r"-?\d+(\.\d+)?(E[+-]?\d+)?")


class OphirMeter:
    """A calibrated power meter: the reference that the rig's photodiode is compared with."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self._owed = False  # an answer that was not waited for may still come
        self._inbox: Inbox[str] = Inbox(link, LineFramer())
        self.model = self._identify()
        self.head = self._ask("HI", str)

    def _once(self, command: str) -> str:
        if self._owed:
            self._resynchronise()
        self._inbox.clear()
        self.link.write(f"${command}\r\n".encode("ascii"))
        identity = command in ("II", "HI")
        line = self._inbox.next(lambda m: m[:1] in "*?" and (identity or not self._is_identity(m)), ANSWER_S)
        self._owed = line is None
        if line is None:
            raise self.link.no_answer(f"${command}", ANSWER_S)
        # a power after `?` is a garbled `*`, not a refusal
        if line.startswith("?") and not POWER.fullmatch(line[1:].strip()):
            problem = f"refused ${command} ({line[1:].strip()})"
            raise self.link.error(DeviceRefused, problem, "check that a sensor head is plugged in")
        return line[1:].strip() if line.startswith("*") else line

    def _is_identity(self, line: str) -> bool:
        return line[1:].strip().upper().startswith(METERS)

    def _resynchronise(self) -> None:
        """Answers come in order: once the meter has said who it is, no older answer can come any more."""
        self._inbox.drain(QUIET_S)
        self.link.write(b"$II\r\n")
        self._owed = self._inbox.next(self._is_identity, RESYNC_S) is None

    def _ask(self, command: str, parse: Callable[[str], T]) -> T:
        return asked(self.link, f"${command}", partial(self._once, command), parse, self._resynchronise)

    def _identify(self) -> str:
        try:
            answer = self._ask("II", str)
        except (NoAnswer, DeviceRefused) as error:
            raise self.link.wrong_device(f"is not an Ophir meter: asked $II, {self.link.heard()}") from error
        model = answer.split()[0].upper() if answer else ""
        if model not in METERS:
            raise self.link.wrong_device(f"is not an Ophir meter that is known here: it answered {answer[:40]!r}")
        return model

    def read(self) -> float:
        """Watts on the sensor."""

        def watts(answer: str) -> float:
            if answer.upper() == "OVER":
                return math.inf
            if not POWER.fullmatch(answer):
                raise ValueError(answer)
            return float(answer)

        value = self._ask("SP", watts)
        if math.isinf(value):
            raise self.link.error(DeviceFault, "is over its range", "choose a higher range or attenuate the beam")
        return value

    def close(self) -> None:
        """Give the port back."""
        self.link.close()
