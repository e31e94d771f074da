"""A recorded byte log (`hw.serial.bytelog`) in the device's place: what a bench has recorded replays as a test."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from hw.base.clock import VirtualClock
from hw.base.errors import DiscoError, InputError
from hw.serial.bytelog import HEADER, Event

MARKS = ("open", ">", "<", "!", "close")


def read_log(path: Path) -> list[Event]:
    """The events of a log; a last line that a crash has cut off is left out. Raises: InputError."""
    try:
        lines = path.read_text(encoding="ascii").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read ({error})", file=path) from error
    if lines[0] != HEADER:
        raise InputError("not a byte log of this version", file=path, value=lines[0][:60], allowed=HEADER)
    return [_event(path, number, line) for number, line in enumerate(lines[1:-1], 2)]


def _event(path: Path, number: int, line: str) -> Event:
    try:
        time, mark, *data = line.split(" ")
        if mark not in MARKS or len(data) > 1:
            raise ValueError(f"unknown event {mark!r}")
        return Event(float(time), mark, bytes.fromhex("".join(data)))
    except ValueError as error:
        raise InputError(f"line {number} is damaged ({error})", file=path, value=line[:60]) from error


class ReplayPeer:
    """The device's side of a recorded log, for `hw.serial.ports.protocol_memory.attach`.

    The computer must send what was sent then, byte for byte (in whatever pieces); what was received then arrives once
    everything before it was sent. Time is the recording's.
    """

    def __init__(self, events: Iterable[Event], clock: VirtualClock) -> None:
        self._events = [e for e in events if e.mark in "<>"]
        self._clock, self._place, self._sent = clock, 0, b""

    def opened(self) -> None:
        """A recorded device is always there."""

    def closed(self) -> None:
        """Nothing to do."""

    @property
    def _next(self) -> Event | None:
        return self._events[self._place] if self._place < len(self._events) else None

    @property
    def finished(self) -> bool:
        """Whether every byte of the log has been exchanged."""
        return self._place == len(self._events) and not self._sent

    def receive(self, data: bytes) -> None:
        """Compare with what was sent when the log was written."""
        self._sent += data
        while self._sent:
            event = self._next
            if event is None or event.mark == "<":
                raise DiscoError(f"replay: {self._sent!r} was sent where the log has {event}")
            size = min(len(event.data), len(self._sent))
            if event.data[:size] != self._sent[:size]:
                raise DiscoError(f"replay: {self._sent!r} was sent where the log has {event.data!r} ({event})")
            self._sent = self._sent[size:]
            self._shorten(event, size)

    def deliver(self, size: int, timeout_s: float) -> bytes:
        """What the log has next, at its time; nothing within the timeout if it is the computer's turn."""
        now, event = self._clock.now(), self._next
        if event is None or event.mark == ">" or event.time_s > now + timeout_s:
            self._clock.sleep(timeout_s)
            return b""
        self._clock.sleep(event.time_s - now)
        self._shorten(event, min(size, len(event.data)))
        return event.data[:size]

    def waiting(self) -> int:
        """Bytes of the next event, if it is the device's and due."""
        event = self._next
        due = event is not None and event.mark == "<" and event.time_s <= self._clock.now()
        return len(event.data) if event is not None and due else 0

    def _shorten(self, event: Event, size: int) -> None:
        """The first bytes of the event at hand are done."""
        if size < len(event.data):
            self._events[self._place] = Event(event.time_s, event.mark, event.data[size:])
        else:
            self._place += 1
