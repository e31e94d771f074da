"""The firmware of an Ophir Vega power meter, in front of whatever light falls on its sensor."""

from __future__ import annotations

from collections.abc import Callable

from disco_twin.firmware.wire import LineFirmware, Timed

BAUD = 9600
LATENCY_S = 0.02


class OphirFirmware(LineFirmware):
    """`watts()` is the light on the sensor; above `range_w` the meter answers OVER."""

    baud = BAUD

    def __init__(self, watts: Callable[[], float], range_w: float = 0.03, model: str = "Vega") -> None:
        super().__init__(b"\r\n")
        self.watts, self.range_w, self.model = watts, range_w, model

    def answers(self, command: str, now: float) -> list[Timed]:
        """One line to each command, which starts with $."""
        return [(LATENCY_S, f"{self._answer(command[1:])}\r\n".encode("ascii"))] if command.startswith("$") else []

    def _answer(self, command: str) -> str:
        match command.upper():
            case "II":
                return f"*{self.model.upper()} 123456 {self.model}"
            case "HI":
                return "*SI 98765 PD300 00000003"
            case "SP":
                watts = self.watts()
                return "*OVER" if watts > self.range_w else f"*{watts:.3E}"
            case _:
                return "?UNKNOWN COMMAND"
