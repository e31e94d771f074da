"""The cable between a computer and an emulated device: baud rate, latency, and what goes wrong on a cable.

A device's firmware is a pure state machine: bytes in, timed bytes out. `Cable` lets its answers arrive when a real line
would deliver them, and implements `hw.serial.ports.protocol_memory.Peer`, so that drivers reach it as `memory://NAME`.
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from collections.abc import Callable
from typing import Protocol

from hw.base.clock import Clock

Timed = tuple[float, bytes]  # seconds from now, bytes of one message
Fault = Callable[[bytes], list[Timed]]  # what becomes of an answer

TICK_S = 1e-9  # the shortest wait: a sum of times may fall short of the time that it was meant to reach
BITS_PER_BYTE = 10  # start, eight bits, stop


class Firmware(Protocol):
    """A device: parser and state."""

    baud: int

    def opened(self, now: float) -> None:
        """The port was opened: some boards reset."""

    def feed(self, data: bytes, now: float) -> list[Timed]:
        """Bytes from the computer; what the device answers, in order, and when."""

    def power_cycle(self, now: float) -> None:
        """The mains failed and came back."""


class LineFirmware:
    """Firmware whose commands are texts that end in a byte of `ends`; opening the port forgets one that has begun."""

    def __init__(self, ends: bytes) -> None:
        self._ends, self._begun = ends, bytearray()

    def opened(self, now: float) -> None:
        """The device goes on with what it does."""
        self._begun.clear()

    def power_cycle(self, now: float) -> None:
        """As opening."""
        self.opened(now)

    def feed(self, data: bytes, now: float) -> list[Timed]:
        """Answer every command that ends in these bytes."""
        answers: list[Timed] = []
        for byte in data:
            if byte not in self._ends:
                self._begun.append(byte)
                continue
            command, self._begun = self._begun.decode("latin-1"), bytearray()
            answers += self.answers(command, now)
        return answers

    def answers(self, command: str, now: float) -> list[Timed]:
        """What the device answers to a command without its end, and when."""
        raise NotImplementedError


# ---- what may become of an answer


def lost(data: bytes) -> list[Timed]:
    """It never arrives; what it answers has happened."""
    return []


def late(seconds: float) -> Fault:
    """It arrives later: likely as the answer to the next command."""
    return lambda data: [(seconds, data)]


def split(at: int, pause_s: float = 0.05) -> Fault:
    """It arrives in two pieces."""
    return lambda data: [(0.0, data[:at]), (pause_s, data[at:])]


def garbled(at: int, mask: int = 0x15) -> Fault:
    """Some bits of one byte are wrong."""

    def fault(data: bytes) -> list[Timed]:
        i = at % len(data)
        return [(0.0, data[:i] + bytes([data[i] ^ mask]) + data[i + 1 :])]

    return fault


def after(noise: bytes) -> Fault:
    """Other bytes arrive in the same read, before it: NULs, garbage, a message, another answer."""
    return lambda data: [(0.0, noise + data)]


def broken_by(message: bytes, at: int) -> Fault:
    """Another message breaks into it."""
    return lambda data: [(0.0, data[:at] + message + data[at:])]


# ---- the cable


class Cable:
    """A device on its cable. Faults are queued: each befalls one answer, or one write of the computer."""

    def __init__(self, firmware: Firmware, clock: Clock) -> None:
        self.firmware, self.clock = firmware, clock
        self.answer_faults: deque[Fault | None] = deque()
        self.command_faults: deque[Callable[[bytes], bytes] | None] = deque()
        self.plugged = True
        self.on_closed: Callable[[], None] = lambda: None  # the last holder of the port has closed it
        self._users = 0  # an old handle may be closed after a new one was opened
        self._coming: list[Timed] = []  # by the time at which the device begins to send them
        self._free = self._held_until = self._taken = -math.inf
        self._arrived = bytearray()

    # ---- what a test or a user does to it

    def unplug(self) -> None:
        """Pull the cable: the port is dead until it is plugged in and opened again."""
        self.plugged, self._users = False, 0
        self._forget()

    def plug(self) -> None:
        """Put the cable back."""
        self.plugged = True

    def power_cycle(self) -> None:
        """Switch the device off and on; the port (its USB adapter) survives."""
        self._forget()
        self.firmware.power_cycle(self.clock.now())

    def say(self, data: bytes) -> None:
        """The device sends something unasked."""
        self._send([(0.0, data)], self.clock.now())

    def _forget(self) -> None:
        self._coming.clear()
        self._arrived.clear()
        self._free = self._held_until = self._taken = -math.inf

    # ---- the computer's side

    def opened(self) -> None:
        """The port was opened."""
        if not self.plugged:
            raise OSError(2, "no such port: the device is unplugged")
        self._users += 1
        self._forget()
        self.firmware.opened(self.clock.now())

    def closed(self) -> None:
        """The port was closed; the device goes on."""
        held, self._users = self._users, max(0, self._users - 1)
        if held == 1:
            self.on_closed()

    def _require_cable(self) -> None:
        if not self._users:
            raise OSError(5, "input/output error: the device is unplugged")

    def receive(self, data: bytes) -> None:
        """Bytes from the computer."""
        self._require_cable()
        fault = self.command_faults.popleft() if self.command_faults else None
        if fault is not None:
            data = fault(data)
        arrived = self._taken = max(self.clock.now(), self._taken) + self._duration(data)
        self._send(self.firmware.feed(data, arrived), arrived)

    def _send(self, answers: list[Timed], now: float) -> None:
        for delay, data in answers:
            fault = self.answer_faults.popleft() if self.answer_faults else None
            for more, piece in [(0.0, data)] if fault is None else fault(data):
                start = max(now + delay + more, self._held_until)
                if more > 0.0:  # what is late keeps its place in the order
                    self._held_until = start
                bisect.insort(self._coming, (start, piece), key=lambda timed: timed[0])

    def _duration(self, data: bytes) -> float:
        return len(data) * BITS_PER_BYTE / self.firmware.baud

    def next_arrival(self) -> float:
        """When the next bytes will have arrived; infinity if none are on their way."""
        if not self._coming:
            return math.inf
        start, piece = self._coming[0]
        return max(start, self._free) + self._duration(piece)

    def waiting(self) -> int:
        """Bytes that have arrived."""
        self._require_cable()
        while (arrival := self.next_arrival()) <= self.clock.now():
            self._free = arrival
            self._arrived += self._coming.pop(0)[1]
        return len(self._arrived)

    def deliver(self, size: int, timeout_s: float) -> bytes:
        """At most `size` bytes; lets the clock go on to the first of them, or to the timeout."""
        end = self.clock.now() + timeout_s
        while not self.waiting() and (now := self.clock.now()) < end:
            self.clock.sleep(max(min(end, self.next_arrival()) - now, TICK_S))
        data = bytes(self._arrived[:size])
        del self._arrived[:size]
        return data
