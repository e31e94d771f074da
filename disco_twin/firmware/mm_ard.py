"""The MM-Ard firmware, version 5, and what it drives: DAC, galvos, TTL lines, converter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from disco_twin.firmware.turning import approach
from disco_twin.firmware.wire import Timed
from hw.devices.mm_ard import BAUD, BOOT_S, LINES, PINS, STEPS

LATENCY_S = 0.001  # the board answers at once; USB polls every millisecond
ARGUMENT_S = 1.0
GALVO_S = 0.004  # from one end of the range to the other
ARGUMENTS = {1: 1, 3: 3, 22: 1, 41: 1}


@dataclass
class Galvo:
    """One mirror: follows its DAC value at a constant speed."""

    start: float = STEPS // 2
    target: int = STEPS // 2
    since: float = 0.0

    def position(self, now: float) -> float:
        """In steps."""
        return approach(self.start, self.target, (now - self.since) * STEPS / GALVO_S)

    def aim(self, target: int, now: float) -> None:
        """A new DAC value."""
        self.start, self.target, self.since = self.position(now), target, now


@dataclass
class MirrorHead:
    """What the board drives. `sample(pin)` is what the converter sees, 0 .. 1023.

    `on_move` is called before every mirror move, `on_lines` after every change of the TTL lines.
    """

    sample: Callable[[int], int] = lambda pin: 0
    on_move: Callable[[], None] = lambda: None
    on_lines: Callable[[], None] = lambda: None
    channels: int = 2
    galvos: tuple[Galvo, Galvo] = field(default_factory=lambda: (Galvo(), Galvo()))
    lines: int = 0
    pattern: int = 0
    blanking: bool = False
    blank_on_high: bool = False

    def settled(self, now: float) -> bool:
        """Whether both mirrors stand still."""
        return all(g.position(now) == g.target for g in self.galvos)

    def write(self, channel: int, value: int, now: float) -> None:
        """To the DAC: channel 0 is A, any other B. Without a DAC nothing happens."""
        if self.channels >= 2:
            self.on_move()
            self.galvos[0 if channel == 0 else 1].aim(value, now)

    def set_pattern(self, pattern: int) -> None:
        """The TTL pattern."""
        self.pattern = pattern & (1 << LINES) - 1
        if not self.blanking:
            self._drive(self.pattern)
        self.follow_trigger()

    def follow_trigger(self) -> None:
        """Blanking mode: the trigger input, which nothing is plugged into, is low. Leaving it changes no line."""
        if self.blanking:
            self._drive(self.pattern if self.blank_on_high else 0)

    def _drive(self, lines: int) -> None:
        changed, self.lines = lines != self.lines, lines
        if changed:
            self.on_lines()


class MmArdFirmware:
    """The parser. Unknown bytes, and commands whose arguments do not come within 1 s, get no answer."""

    baud = BAUD

    def __init__(self, head: MirrorHead) -> None:
        self.head = head
        self._ready = 0.0
        self._command: list[int] = []
        self._last = 0.0

    def opened(self, now: float) -> None:
        """Opening the port resets the board: its lines fall, the DAC keeps its values."""
        self._command.clear()
        self._ready = now + BOOT_S
        self.head.blanking = self.head.blank_on_high = False
        self.head.set_pattern(0)

    def power_cycle(self, now: float) -> None:
        """As opening, and the DAC starts at 0."""
        self.opened(now)
        for galvo in self.head.galvos:
            galvo.aim(0, now)

    def feed(self, data: bytes, now: float) -> list[Timed]:
        """Answer every command that ends in these bytes."""
        answers: list[Timed] = []
        for byte in data:
            if now < self._ready:
                continue
            if self._command and now - self._last > ARGUMENT_S:
                self._command.clear()
            self._last = now
            self._command.append(byte)
            if len(self._command) > ARGUMENTS.get(self._command[0], 0):
                answer = self._answer(self._command[0], self._command[1:], now)
                self._command = []
                if answer:
                    answers.append((LATENCY_S, answer))
        return answers

    def _answer(self, command: int, arguments: list[int], now: float) -> bytes:
        head = self.head
        match command:
            case 1:
                head.set_pattern(arguments[0])
                return b"\1"
            case 2:
                return bytes([2, head.lines])
            case 3:
                channel, high, low = arguments
                high &= 0x0F
                head.write(channel, high << 8 | low, now)
                return bytes([3, channel, high, low])
            case 20 | 21:
                head.blanking = command == 20
                head.follow_trigger()
                return bytes([command])
            case 22:
                head.blank_on_high = arguments[0] == 0
                head.follow_trigger()
                return bytes([22])
            case 30:
                return b"MM-Ard\r\n"
            case 31:
                return b"5\r\n"
            case 34:
                return bytes([34, head.channels])
            case 41 if arguments[0] < PINS:
                value = head.sample(arguments[0])
                return bytes([41, arguments[0], value >> 8, value & 0xFF])
            case _:
                return b""
