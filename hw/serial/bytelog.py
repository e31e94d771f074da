"""The byte log: every byte to and from a device with its time, appended as it happens, and replayed as a test.

One line an event: seconds, `open`, `>` (to the device), `<` (from it), `!` (an error) or `close`, and the bytes in
hex. The first line of a file names the format. A log that a bench has recorded is attached with `ReplayPeer`: the same
driver must then send the same bytes, and gets the answers that were recorded.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from hw.base.clock import VirtualClock
from hw.base.errors import DiscoError, InputError

log = logging.getLogger(__name__)

HEADER = "disco-twin byte log, format_version 1"
MARKS = ("open", ">", "<", "!", "close")


@dataclass(frozen=True)
class Event:
    """Something that happened on a port."""

    time_s: float
    mark: str
    data: bytes

    def __str__(self) -> str:
        return f"{self.time_s:.6f} {self.mark} {self.data.hex()}".rstrip()


class ByteLog:
    """Appends to a file, line by line, flushed: it is complete up to the moment of a crash.

    A log that cannot be written any more (a full disk) ends with one warning: the device goes on without it.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._failed = path, False
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("a", encoding="ascii", buffering=1)
            if self._file.tell() == 0:
                self._file.write(HEADER + "\n")
        except OSError as error:
            problem = f"cannot be written ({error.strerror})"
            raise InputError(problem, file=path, remedy="choose another folder for the byte logs") from error

    def note(self, time_s: float, mark: str, data: bytes) -> None:
        """Add an event."""
        if self._failed:
            return
        try:
            self._file.write(f"{Event(time_s, mark, data)}\n")
        except OSError as error:
            self._give_up(error)

    def close(self) -> None:
        """End the log."""
        try:
            self._file.close()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        if not self._failed:
            log.warning("%s: the byte log ends here (%s)", self.path, error.strerror)
        self._failed = True


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
