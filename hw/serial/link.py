"""The link to a device: opens its port, sends and receives bytes, waits within limits, and writes the byte log.

Every protocol has a framer, a pure function object from bytes to messages, and an `Inbox` in front of the link that
waits for messages. Drivers (`hw.devices`) interpret the messages; `asked` is a question that may be repeated.
"""

from __future__ import annotations

import errno
import logging
import re
from collections import deque
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

import serial

from hw.base.clock import Clock
from hw.base.errors import DeviceError, Garbled, NoAnswer, SwitchedOff, Unplugged, WrongDevice
from hw.safety.device_port import FAILURES
from hw.safety.ports.protocol_supervised import REMEDY as AFTER_DARK
from hw.safety.ports.protocol_supervised import GoneDark
from hw.serial.bytelog import ByteLog

log = logging.getLogger(__name__)

M = TypeVar("M")
A = TypeVar("A")
E = TypeVar("E", bound=DeviceError)

SLICE_S = 0.02  # a port is never waited for longer at a time: the precision of time limits
WRITE_TIMEOUT_S = 1.0
HEARD_BYTES = 40
REMEDY = "check cable and power, and the port's name in the rig file (`disco-twin rig probe` lists what answers)"

LISTED = "`ls -l /dev/serial/by-id` lists what is there"
# Why a port cannot be opened, and the remedy, by error number.
NOT_THERE = ("there is no such device", f"plug it in, switch it on and correct the port: {LISTED}")
FORBIDDEN = (
    "permission denied",
    "join the group that owns the port (`sudo usermod -aG dialout $USER` in most cases, then log in again)",
)
IN_USE = (
    "another program uses it",
    "end that program (`fuser -v` and the port names it), but no supervisor: it makes the device dark, then ends",
)
NO_PORT = ("it is no serial port", f"name the device's port: {LISTED}")
NOBODY = ("nobody answers there", "start the program that serves the port, or correct the port")
TROUBLE = (
    dict.fromkeys((errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO, errno.ELOOP), NOT_THERE)
    | dict.fromkeys((errno.EACCES, errno.EPERM), FORBIDDEN)
    | dict.fromkeys((errno.EBUSY, errno.EAGAIN), IN_USE)
    | dict.fromkeys((errno.ENOTTY, errno.EISDIR, errno.ENOTDIR), NO_PORT)
    | {errno.ECONNREFUSED: NOBODY}
)
NUMBER = re.compile(r"\[Errno (\d+)\]|\((\d+), '")  # pyserial and the supervisor give it as text alone

for _ports in ("hw.serial.ports", "hw.safety.ports"):
    if _ports not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(_ports)


class Framer(Protocol[M]):
    """Cuts a stream of bytes, in whatever pieces it arrives, into messages."""

    def feed(self, data: bytes) -> list[M]: ...
    def reset(self) -> None:
        """Forget an unfinished message."""


class LineFramer:
    """Lines without CR and LF; NULs are dropped."""

    def __init__(self) -> None:
        self._line = bytearray()

    def reset(self) -> None:
        """Forget an unfinished line."""
        self._line.clear()

    def feed(self, data: bytes) -> list[str]:
        """The lines that end in these bytes."""
        lines = []
        for byte in data:
            if byte in b"\r\n":
                if self._line:
                    lines.append(self._line.decode("latin-1"))
                self._line.clear()
            elif byte:
                self._line.append(byte)
        return lines


class Link:
    """An open port. `device` is what the rig calls the device, and begins every error."""

    def __init__(self, url: str, baud: int, device: str, clock: Clock, log: ByteLog | None = None) -> None:
        """Open the port.

        Raises: Unplugged where it cannot be opened, as every method does from the moment that it fails.
        """
        self.url, self.device, self.clock, self._log = url, device, clock, log
        self._heard = b""
        self._gone = False
        try:
            self._port = serial.serial_for_url(
                url, baudrate=baud, timeout=SLICE_S, write_timeout=WRITE_TIMEOUT_S, exclusive=True
            )
        except FAILURES as error:
            problem, remedy = _trouble(error)
            raise self._lost(f"cannot be opened: {problem}", error, remedy) from error
        self._note("open", b"")

    def write(self, data: bytes) -> None:
        """Send all bytes."""
        try:
            self._port.write(data)
        except FAILURES as error:
            raise self._lost(f"does not take bytes any more: {_why(error)}", error) from error
        self._heard = b""
        self._note(">", data)

    def read(self, timeout_s: float) -> bytes:
        """The bytes that arrive next, none if nothing arrives in time. With 0, what is there already."""
        end = self.clock.now() + timeout_s
        while True:
            data = self._read_slice(wait=timeout_s > 0.0)
            if data or self.clock.now() >= end:
                return data

    def _read_slice(self, wait: bool) -> bytes:
        try:
            there = self._port.in_waiting
            data = bytes(self._port.read(max(1, there))) if there or wait else b""
        except FAILURES as error:
            raise self._lost(f"cannot be read any more: {_why(error)}", error) from error
        if data:
            self._heard = (self._heard + data)[:HEARD_BYTES]
            self._note("<", data)
        return data

    def heard(self) -> str:
        """What has come since the last question, in words: for errors about devices that speak something else."""
        return f"{self._heard!r} came" if self._heard else "nothing answered"

    def error(self, kind: type[E], problem: str, remedy: str) -> E:
        """An error of this device."""
        return kind(self.url, self.device, problem, remedy)

    def wrong_device(self, problem: str, keys: str = "the ports") -> WrongDevice:
        """Another device than the driver's is at the port. keys: of the rig file, to be checked."""
        remedy = f"check {keys} in the rig file; `disco-twin rig probe` lists which device is where"
        return self.error(WrongDevice, problem, remedy)

    def no_answer(self, asked: object, limit_s: float) -> NoAnswer:
        """Nothing came in time."""
        return self.error(NoAnswer, f"did not answer {asked} within {limit_s:g} s", "check its cable and power")

    def close(self) -> None:
        """Give the port back and end the log; never raises, may be called twice."""
        try:
            self._port.close()
        except OSError as error:
            self._note("!", str(error).encode())
        self._note("close", b"")
        if self._log is not None:
            self._log.close()
            self._log = None

    def _note(self, mark: str, data: bytes) -> None:
        if self._log is not None:
            self._log.note(self.clock.now(), mark, data)

    def _lost(self, what: str, error: Exception, remedy: str = REMEDY) -> Unplugged:
        kind, remedy = (SwitchedOff, AFTER_DARK) if isinstance(error, GoneDark) else (Unplugged, remedy)
        lost = kind(self.url, f"the port of {self.device}", what, remedy)
        lost.known, self._gone = self._gone, True
        self._note("!", str(error).encode())
        return lost


def _why(error: Exception) -> str:
    """Why an open port fails: what systems and libraries call it goes into the byte log."""
    if isinstance(error, GoneDark):
        return str(error)
    if isinstance(error, serial.SerialTimeoutException):
        return f"none were taken in {WRITE_TIMEOUT_S:g} s"
    return "its cable was pulled, or it lost power"


def _trouble(error: Exception) -> tuple[str, str]:
    """Why a port cannot be opened, and the remedy."""
    found = NUMBER.search(str(error))
    number = int(found[1] or found[2]) if found else 0
    return TROUBLE.get(number, (str(error), REMEDY))


class Inbox(Generic[M]):
    """The messages that a device has sent and nobody has taken."""

    def __init__(self, link: Link, framer: Framer[M]) -> None:
        self._link, self._framer = link, framer
        self._messages: deque[M] = deque()

    def next(self, wanted: Callable[[M], bool], timeout_s: float) -> M | None:
        """The first message that is wanted, or None in time; all others are dropped."""
        clock = self._link.clock
        end = clock.now() + timeout_s
        while True:
            while self._messages:
                message = self._messages.popleft()
                if wanted(message):
                    return message
            left = end - clock.now()
            if left <= 0.0:
                return None
            self._messages.extend(self._framer.feed(self._link.read(left)))

    def clear(self) -> None:
        """Drop what has arrived by now: before a command, so that nothing older answers it."""
        while data := self._link.read(0.0):
            self._framer.feed(data)
        self._framer.reset()
        self._messages.clear()

    def drain(self, quiet_s: float, limit_s: float = 5.0) -> bool:
        """Drop everything until nothing has arrived for a while; False if the device does not fall silent."""
        clock = self._link.clock
        end = clock.now() + limit_s
        while self._link.read(quiet_s):
            if clock.now() > end:
                return False
        self.clear()
        return True


def asked(
    link: Link, question: str, ask_once: Callable[[], A], parse: Callable[[A], M], recover: Callable[[], None]
) -> M:
    """The answer to what may be asked twice, parsed (ValueError: it cannot be); repeated as by `persist`.

    Raises: NoAnswer, Garbled.
    """

    def attempt() -> M:
        answer = ask_once()
        try:
            return parse(answer)
        except ValueError as error:
            problem = f"answered {question} with {str(answer)[:40]!r}, which makes no sense"
            raise link.error(Garbled, problem, "check its cable, baud rate and grounding") from error

    return persist(attempt, recover)


def persist(attempt: Callable[[], M], recover: Callable[[], None], tries: int = 3) -> M:
    """Try what may be done twice (reading, or setting to a value) again when the answer was lost or garbled.

    `recover` runs in between and makes sure that an answer to the lost attempt cannot answer the next one.
    """
    for _ in range(tries - 1):
        try:
            return attempt()
        except (NoAnswer, Garbled) as error:
            log.warning("%s; trying again", error.without_remedy)
            recover()
    return attempt()
