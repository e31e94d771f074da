"""A device of the supervisor: lent to the program, and from some moment on made dark. It is never lent again.

Nothing here waits: neither for the program, which may not read, nor for the device, which may not answer.
"""

from __future__ import annotations

import logging
import os
import socket
import termios
import time
from collections.abc import Generator

import serial

from hw.safety.darkness import KINDS, Answer, Confirmed, Ready

log = logging.getLogger("supervisor")

ANSWER_S = 0.06  # emulated and real devices answer within 30 ms
RETRY_S = 0.2  # of opening a port
PATIENCE_S = 5.0  # with what does not confirm: then the user is warned
RETURN_S = 600.0  # how long a device that was told to let light out, or a port that vanished, is not given up
REMEDY = "Open the interlock or turn the lasers' keys"
FAILURES = (OSError, termios.error, ValueError)  # of a port; pyserial lets the second through


class SupervisedDevice:
    """`dark`: by which it is made dark, None while it is lent. `lit`: it was told to let light out, or may have been.

    `host` is the supervisor's end of the program's socket.
    """

    def __init__(self, host: socket.socket, request: bytes) -> None:
        """Open the port, and tell the device to be dark before anything else is said to it.

        request: `kind baud lit url`

        Raises: one of FAILURES where the port cannot be opened; not if the device may be lit, which is insisted on.
        """
        kind, baud, lit, self.url = request.decode().split(" ", 3)
        self.host, self.kind, self._baud, self.lit = host, KINDS[kind], int(baud), lit == "1"
        self.dark: Confirmed | None = None
        self._port: serial.SerialBase | None = None
        self._to_device = self._to_host = self._said = b""
        try:
            self._open()
            self._write(self.kind.off)
        except FAILURES as error:
            if not self.lit:
                raise
            log.info("%s: %s", self.url, error)
            self.make_dark()

    # ---- the port

    def _open(self) -> None:
        self._port = serial.serial_for_url(self.url, baudrate=self._baud, timeout=0, exclusive=True)
        os.set_blocking(self._port.fileno(), False)

    def _file(self) -> int:
        if self._port is None:
            raise OSError("it is closed")
        return int(self._port.fileno())

    def _write(self, data: bytes) -> bytes:
        """What the port does not take now."""
        try:
            return data[os.write(self._file(), data) :]
        except BlockingIOError:
            return data

    def _read(self, ready: Ready) -> bytes:
        if self._file() not in ready:
            return b""
        data = os.read(self._file(), 4096)
        if not data:
            raise OSError("it has hung up")
        return data

    def close(self) -> None:
        """Give the port back."""
        port, self._port = self._port, None
        try:
            if port is not None:
                port.close()
        except FAILURES as error:
            log.debug("%s: %s", self.url, error)  # it is gone

    # ---- what the supervisor does with it

    def sources(self) -> list[int]:
        """What `serve` reads as soon as there is something; what was not taken is offered again at every tick."""
        port = [] if self._port is None or self._to_host else [self._file()]
        return port if self.dark is not None or self._to_device else [*port, self.host.fileno()]

    def serve(self, ready: Ready) -> bool | None:
        """Hand bytes to and fro or, once it is made dark, go on with that; None: there is more to do.

        Returns: True when it has confirmed that it is dark, False when it is given up.

        Raises: OSError where its port is gone while it is lent.
        """
        if self.dark is not None:
            try:
                self.dark.send(ready)
            except StopIteration as end:
                return bool(end.value)
            return None
        self._to_host = self._to_host or self._read(ready)
        try:
            if self.host.fileno() in ready:
                self._to_device = self.host.recv(4096, socket.MSG_DONTWAIT)
                if not self._to_device:
                    return self.make_dark()  # the program has closed it
                self._said = self._said[-3:] + self._to_device  # a command may arrive in pieces
                self.lit = self.lit or self.kind.lights.search(self._said) is not None
            if self._to_host:
                self._to_host = self._to_host[self.host.send(self._to_host, socket.MSG_DONTWAIT) :]
        except BlockingIOError:  # it does not read
            pass
        except ConnectionError:
            return self.make_dark()
        if self._to_device:
            self._to_device = self._write(self._to_device)
        return None

    def make_dark(self) -> bool | None:
        """Tell it to be dark, now; `serve` insists from here on."""
        self.dark, self._to_host = self._insist(), b""
        next(self.dark)
        return None  # not confirmed yet

    def _insist(self) -> Confirmed:
        """Attempt after attempt, by a port that is opened anew whenever it fails."""
        begun, warned = time.monotonic(), False
        while time.monotonic() < begun + (RETURN_S if self.lit else PATIENCE_S):
            try:
                if self._port is None:
                    yield from self._wait(RETRY_S)
                    self._open()
                if (yield from self.kind.confirmed(self._ask)):
                    return True
            except FAILURES as error:
                log.info("%s: %s; trying again", self.url, error)
                if self._port is not None and self.lit and not warned:
                    warned = True
                    log.error("%s: THE PORT IS GONE, AND LIGHT MAY BE ON. %s; it is made dark when the port returns",
                              self.url, REMEDY)  # fmt: skip
                self.lit = self.lit or self._port is not None  # or may have been
                self.close()
            if time.monotonic() > begun + PATIENCE_S and not warned:
                warned = True
                log.error("%s: %s. %s", self.url, self.kind.warning, REMEDY)
        return False

    def _ask(self, command: bytes, answer: Answer) -> Generator[None, Ready, bytes | None]:
        self._write(command)
        return (yield from self._wait(ANSWER_S, answer))

    def _wait(self, seconds: float, answer: Answer = lambda heard: None) -> Generator[None, Ready, bytes | None]:
        """For an answer, or for this time to pass."""
        end, heard = time.monotonic() + seconds, b""
        while time.monotonic() < end:
            ready = yield
            heard += self._read(ready) if self._port is not None else b""
            if (found := answer(heard)) is not None:
                return found
        return None
