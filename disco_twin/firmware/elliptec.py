"""The firmware of a Thorlabs Elliptec rotation stage in front of a `Spindle`. Answers a move when it has ended."""

from __future__ import annotations

from disco_twin.firmware.turning import Spindle
from disco_twin.firmware.wire import Timed

BAUD = 9600
LATENCY_S = 0.005
ARGUMENT_S = 2.0
PULSES = 143_360  # a turn of the ELL14
LENGTHS = {"in": 3, "gs": 3, "gp": 3, "ho": 4, "ma": 11, "mr": 11}
TIME_OUT, MECHANICAL, UNKNOWN, BUSY = 1, 2, 3, 9


class ElliptecFirmware:
    """One stage. Commands have no end mark: their length follows from their letters."""

    baud = BAUD

    def __init__(self, spindle: Spindle, address: str = "0", kind: int = 0x0E) -> None:
        self.spindle, self.address, self.kind = spindle, address, kind
        self._buffer = ""
        self._last = 0.0

    def opened(self, now: float) -> None:
        """Opening the port changes nothing."""
        self._buffer = ""

    def power_cycle(self, now: float) -> None:
        """The reference is lost."""
        self._buffer = ""
        self.spindle.power_cycle(now)

    def feed(self, data: bytes, now: float) -> list[Timed]:
        """Answer every command that ends in these bytes."""
        answers: list[Timed] = []
        for byte in data.decode("latin-1"):
            if self._buffer and now - self._last > ARGUMENT_S:
                self._buffer = ""
                answers.append((LATENCY_S, self._status(TIME_OUT)))
            self._last = now
            if byte in "\r\n\0" and not self._buffer:
                continue
            self._buffer += byte
            if len(self._buffer) >= LENGTHS.get(self._buffer[1:3], 3):
                command, self._buffer = self._buffer, ""
                if command[0] == self.address:
                    answers.append(self._answer(command[1:3], command[3:], now))
        return answers

    def _status(self, code: int) -> bytes:
        return f"{self.address}GS{code:02X}\r\n".encode("ascii")

    def _place(self, now: float) -> bytes:
        pulses = round(self.spindle.position(now) / 360.0 * PULSES)
        return f"{self.address}PO{pulses & 0xFFFFFFFF:08X}\r\n".encode("ascii")

    def _answer(self, letters: str, arguments: str, now: float) -> Timed:
        spindle = self.spindle
        if letters == "in":
            # type, serial number, year, firmware, thread and hardware, travel in degrees, pulses a turn
            text = f"{self.address}IN{self.kind:02X}11400609202317010168{PULSES:08X}\r\n"
            return LATENCY_S, text.encode("ascii")
        if letters not in LENGTHS:
            return LATENCY_S, self._status(UNKNOWN)
        if spindle.busy(now):
            return LATENCY_S, self._status(BUSY)
        if letters == "gs":
            return LATENCY_S, self._status(MECHANICAL if spindle.stalled else 0)
        if letters == "gp":
            return LATENCY_S, self._place(now)
        try:
            angle = self._target(letters, arguments, now)
        except ValueError:
            return LATENCY_S, self._status(UNKNOWN)
        duration = spindle.go(angle, now, homing=letters == "ho")
        if spindle.stalled:
            return duration, self._status(MECHANICAL)
        return duration, self._place(now + duration)

    def _target(self, letters: str, arguments: str, now: float) -> float:
        if letters == "ho":
            return 0.0
        pulses = int(arguments, 16)
        pulses -= 1 << 32 if pulses >> 31 else 0
        start = self.spindle.position(now) if letters == "mr" else 0.0
        return start + pulses / PULSES * 360.0
