"""A device of the supervisor: lent to the program, and from some moment on made dark. It is never lent again.

Each of the two is a generator, which is given the descriptors that can be read and goes on as far as it can. Nothing
here waits: neither for the program, which may not read, nor for the device, which may not answer.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Generator
from contextlib import suppress

from hw.safety.darkness import KINDS, Answer, Confirmed, Ready
from hw.safety.device_port import FAILURES, RETURN_S, Port, opened, return_s

log = logging.getLogger("supervisor")

READY = b"\x06"  # to the program: the port is open
ANSWER_S, LATEST_S = 0.06, 0.5  # devices answer within 30 ms; each attempt waits twice as long as the one before
RETRY_S = 0.2  # of opening a port
PATIENCE_S = 5.0  # with what does not confirm: then the user is warned
REMEDY = "Open the interlock or turn the lasers' keys"


class SupervisedDevice:
    """`dark`: it is being made so. `lit`: it was told to let light out, or may have been.

    `host` is the supervisor's end of the program's socket; the first message in it is the request: `kind baud lit url`.
    One that may be lit is made dark at once: its supervisor was killed.
    """

    def __init__(self, host: socket.socket) -> None:
        """Nothing is opened yet. Raises: OSError, KeyError, ValueError where there is no such request."""
        kind, baud, lit, self.url = host.recv(4096, socket.MSG_DONTWAIT).decode().split(" ", 3)
        self.host, self.kind, self._baud, self.lit = host, KINDS[kind], int(baud), lit == "1"
        self.dark = False
        self._port: Port | None = None
        self._return_s, self._answer_s = RETURN_S, ANSWER_S
        with suppress(ValueError):  # of a name that is no path, which opening reports
            self._return_s = return_s(self.url)
        self._to_device = self._to_host = self._said = b""
        self._doing = self._insist() if self.lit else self._lend()
        with suppress(StopIteration):  # it is given up, which `serve` returns
            next(self._doing)

    # ---- what the supervisor does with it

    def sources(self) -> list[int]:
        """What is read as soon as there is something; what was not taken is offered again at every tick."""
        if self._port is None:
            return []
        port = [] if self._to_host else [self._file()]
        return port if self.dark or self._to_device else [*port, self.host.fileno()]

    def serve(self, ready: Ready) -> bool | None:
        """Go on; None: there is more to do.

        Returns: True when it has confirmed that it is dark, or was never opened; False when it is given up.

        Raises: one of FAILURES where its port is gone while it is lent.
        """
        try:
            self._doing.send(ready)
        except StopIteration as end:
            return bool(end.value)
        return None

    def make_dark(self) -> None:
        """Tell it to be dark, now; `serve` insists from here on. A second time it does nothing."""
        if not self.dark:
            self._doing = self._insist()
            with suppress(StopIteration):
                next(self._doing)

    def close(self) -> None:
        """Give the port back."""
        port, self._port = self._port, None
        try:
            if port is not None:
                port.close()
        except FAILURES as error:
            log.debug("%s: %s", self.url, error)  # it is gone

    # ---- the port

    def _open(self) -> Generator[None, Ready, None]:
        self._port = yield from opened(self.url, self._baud)

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

    # ---- lent

    def _lend(self) -> Confirmed:
        """Open the port, tell the device to be dark before anything else is said to it, then hand bytes to and fro."""
        yield
        try:
            yield from self._open()
            self._write(self.kind.off)
        except FAILURES as error:
            with suppress(OSError):  # the program has closed it again
                self.host.send(str(error).encode()[:200])
            return True
        with suppress(OSError):
            self.host.send(READY)
        while self._relay((yield)):
            pass
        return (yield from self._insist())

    def _relay(self, ready: Ready) -> bool:
        """Hand over what there is; False when the program has closed the port."""
        self._to_host = self._to_host or self._read(ready)
        try:
            if self.host.fileno() in ready:
                self._to_device = self.host.recv(4096, socket.MSG_DONTWAIT)
                if not self._to_device:
                    return False
                self._said = self._said[-3:] + self._to_device  # a command may arrive in pieces
                self.lit = self.lit or self.kind.lights.search(self._said) is not None
            if self._to_host:
                self._to_host = self._to_host[self.host.send(self._to_host, socket.MSG_DONTWAIT) :]
        except BlockingIOError:  # it does not read
            pass
        except ConnectionError:
            return False
        if self._to_device:
            self._to_device = self._write(self._to_device)
        return True

    # ---- made dark

    def _insist(self) -> Confirmed:
        """Attempt after attempt, by a port that is opened anew whenever it fails, as long as it may come back."""
        self.dark, self._to_host = True, b""
        begun = gone = time.monotonic()
        warned = False
        while True:
            try:
                if self._port is None:
                    yield from self._open()
                if (yield from self.kind.confirmed(self._ask)):
                    return True
                self._answer_s = min(2 * self._answer_s, LATEST_S)
            except FAILURES as error:
                log.info("%s: %s; trying again", self.url, error)
                if self._port is not None:
                    if self.lit and not warned:
                        warned = True
                        log.error("%s: THE PORT IS GONE, AND LIGHT MAY BE ON. %s%s", self.url, REMEDY, self._returns())
                    gone, self.lit = time.monotonic(), True  # or may have been
                    self.close()
                if self._return_s:
                    yield from self._wait(RETRY_S)
            now = time.monotonic()
            if now > begun + PATIENCE_S and not warned:
                warned = True
                log.error("%s: %s. %s", self.url, self.kind.warning, REMEDY)
            if now >= begun + (RETURN_S if self.lit else PATIENCE_S) or (
                self._port is None and now >= gone + self._return_s
            ):
                return False

    def _returns(self) -> str:
        if self._return_s:
            return f"; it is made dark if the port returns within {self._return_s:g} s"
        return ": the program that served it has ended"

    def _ask(self, command: bytes, answer: Answer) -> Generator[None, Ready, bytes | None]:
        self._write(command)
        return (yield from self._wait(self._answer_s, answer))

    def _wait(self, seconds: float, answer: Answer = lambda heard: None) -> Generator[None, Ready, bytes | None]:
        """For an answer, or for this time to pass."""
        end, heard = time.monotonic() + seconds, b""
        while time.monotonic() < end:
            ready = yield
            heard += self._read(ready) if self._port is not None else b""
            if (found := answer(heard)) is not None:
                return found
        return None
