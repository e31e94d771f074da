"""Ophir power meters (Vega, Nova II) over RS-232, 9600 baud: `$..` CR LF is answered by `*...` or `?...`, CR LF."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import TypeVar

from hw.base.errors import DeviceFault, DeviceRefused, NoAnswer
from hw.serial.dialogue import Dialogue
from hw.serial.link import Link

T = TypeVar("T")

BAUD = 9600
ANSWER_S = 1.0
METERS = ("VEGA", "NOVAII", "NOVA2", "LASERSTAR")
POWER = re.compile(r"-?\d+(\.\d+)?(E[+-]?\d+)?")


class OphirMeter:
    """A calibrated power meter: the reference that the rig's photodiode is compared with."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self._dialogue = Dialogue(link, "\r\n", ("$II", self._is_identity))
        self.model = self._identify()
        self.head = self._ask("HI", str)

    def _is_identity(self, line: str) -> bool:
        return line[1:].strip().upper().startswith(METERS)

    def _ask(self, command: str, parse: Callable[[str], T]) -> T:
        identity = command in ("II", "HI")

        def wanted(line: str) -> bool:
            return line[:1] in "*?" and (identity or not self._is_identity(line))

        def parsed(line: str) -> T:
            # a power after `?` is a garbled `*`, not a refusal
            if line.startswith("?") and not POWER.fullmatch(line[1:].strip()):
                problem = f"refused ${command} ({line[1:].strip()})"
                raise self.link.error(DeviceRefused, problem, "check that a sensor head is plugged in")
            return parse(line[1:].strip() if line.startswith("*") else line)

        return self._dialogue.ask(f"${command}", wanted, ANSWER_S, parsed)

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
        """Watts on the sensor. Raises: DeviceFault where it is over its range."""

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
