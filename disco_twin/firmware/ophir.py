"""The firmware of an Ophir Vega power meter, in front of whatever light falls on its sensor."""

from __future__ import annotations

from collections.abc import Callable

from disco_twin.firmware.wire import Commands, Timed

BAUD = 9600
LATENCY_S = 0.02


class OphirFirmware:
    """`watts()` is the light on the sensor; above `range_w` the meter says OVER."""

    baud = BAUD

    def __init__(self, watts: Callable[[], float], range_w: float = 0.03, model: str = "Vega") -> None:
        self.watts, self.range_w, self.model = watts, range_w, model
        self._commands = Commands(b"\r\n")

    def opened(self, now: float) -> None:
        """Opening the port changes nothing."""
        self._commands.clear()

    def power_cycle(self, now: float) -> None:
        """The meter starts as it was."""
        self._commands.clear()

    def feed(self, data: bytes, now: float) -> list[Timed]:
        """Answer every command that ends in these bytes."""
        answers: list[Timed] = []
        for line in self._commands.complete(data):
            if line.startswith("$"):
                answers.append((LATENCY_S, f"{self._answer(line[1:])}\r\n".encode("ascii")))
        return answers

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
