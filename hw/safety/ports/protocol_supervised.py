"""pyserial's handler of `supervised://KIND:PORT`: a port that the supervisor (`hw.safety.supervisor`) owns and lends.

KIND is `laser` or `board`. Closing the port makes its device dark. Whatever the supervisor takes for a sign that this
program is not in control any more makes all devices dark, and all ports dead.
"""

from __future__ import annotations

import array
import fcntl
import logging
import os
import select
import signal
import socket
import subprocess
import termios
import threading
import time
from contextlib import suppress
from urllib.parse import urlsplit

from serial import PortNotOpenError, SerialBase, SerialException, SerialTimeoutException

from hw.base.children import child_environment, module_command
from hw.base.errors import SwitchedOff
from hw.safety.darkness import KINDS
from hw.safety.signals import ENDING
from hw.safety.supervised_device import READY
from hw.safety.supervisor import BEAT, LEND, stopped

log = logging.getLogger(__name__)

PREFIX = "supervised://"
MODULE = "hw.safety.supervisor"
START_S = 10.0  # the supervisor is a Python process
END_S = 1.0  # what has not confirmed by then is left to the supervisor
IN_USE_S = 2.0  # the supervisor of a program that has just ended may hold the port
BEAT_S = 0.1
REMEDY = "see that every laser is off, then repeat the same command"


def port_of(url: str) -> str:
    """The port itself, of whatever kind its device is; other URLs as they are."""
    return url.removeprefix(PREFIX).partition(":")[2] if url.startswith(PREFIX) else url


def _in_numbers(port: str) -> list[str]:
    """A network port by each address of its host: the supervisor cannot wait for a name. Other ports as they are.

    Raises: SerialException.
    """
    if not port.startswith("socket://"):
        return [port]
    parts = urlsplit(port)
    try:
        found = socket.getaddrinfo(parts.hostname, parts.port, type=socket.SOCK_STREAM)
    except OSError as error:
        raise SerialException(f"{parts.hostname}: {error.strerror}") from error
    addresses = dict.fromkeys(str(entry[4][0]) for entry in found)
    return [f"socket://[{a}]:{parts.port}" if ":" in a else f"socket://{a}:{parts.port}" for a in addresses]


class GoneDark(SerialException):
    """The supervisor has made the device dark, or is about to, and its port is dead; the text says why."""


class Lifeline:
    """This program's end of its supervisor's socket. The supervisor starts with the first port that is opened.

    The socket keeps one descriptor as long as the program lives: Python writes the number of every signal into it, at
    once, whatever the main thread is doing. Signals that the program ignores are not written.
    """

    def __init__(self) -> None:
        self._begin()
        os.register_at_fork(after_in_child=self._leave)

    def _begin(self) -> None:
        self._ours, self._theirs = socket.socketpair()
        self._supervisors: list[subprocess.Popen[bytes]] = []  # the last one is in charge; others still insist
        self._why = ""  # everything is dark
        self._lock = threading.RLock()  # of all that is here
        self.lent: dict[SupervisedPort, str] = {}  # the ports that are open, and the requests for them

    def _leave(self) -> None:
        """In a child that was forked: signals, supervisor and ports are its parent's, and it closes none of them."""
        signal.set_wakeup_fd(-1)
        for port in self.lent:
            port.leave()
        for supervisor in self._supervisors:
            supervisor.returncode = 0  # no child of this process, which is not to wait for it
        for end in (self._ours, self._theirs):
            end.close()
        self._begin()

    def lend(self, request: str) -> socket.socket:
        """Ask for a port. What comes from the socket first is READY, or why the port cannot be opened."""
        with self._lock:
            if not self._supervisors or self.why_dark():
                process, ours, theirs = self._start()
                os.dup2(ours.fileno(), self._ours.fileno())
                self._ours.setblocking(False)
                self._theirs.close()
                self._theirs = theirs  # kept, so that a signal after the supervisor's end meets no broken pipe
                self._why = ""
                ours.close()
                threading.Thread(target=self._beat, args=(process,), daemon=True).start()
            if threading.current_thread() is threading.main_thread():
                signal.set_wakeup_fd(self._ours.fileno(), warn_on_full_buffer=False)
            return self._ask(self._ours, request)

    def _start(self) -> tuple[subprocess.Popen[bytes], socket.socket, socket.socket]:
        ours, theirs = socket.socketpair()
        command = module_command(MODULE, str(theirs.fileno()), str(os.getpid()))
        process = subprocess.Popen(
            command, pass_fds=[theirs.fileno()], env=child_environment(), stdin=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip
        self._supervisors = [*(old for old in self._supervisors if old.poll() is None), process]
        return process, ours, theirs

    @staticmethod
    def _ask(lifeline: socket.socket, request: str) -> socket.socket:
        ours, theirs = socket.socketpair()
        with theirs:
            ours.settimeout(START_S)
            ours.send(request.encode())
            socket.send_fds(lifeline, [LEND], [theirs.fileno()])
        return ours

    def why_dark(self) -> str | None:
        """Why everything is dark, if it is. A supervisor that was killed is found here, and replaced."""
        with self._lock:
            with suppress(BlockingIOError):
                self._why += self._ours.recv(4096).decode(errors="replace") if self._supervisors else ""
            if self._supervisors and not self._why and self._supervisors[-1].poll() is not None:
                status = self._supervisors[-1].returncode
                self._why = f"its supervisor was killed or stopped ({status}); another one makes everything dark"
                if self.lent:
                    log.warning("the supervisor was killed or stopped: making everything dark")
                    _, ours, theirs = self._start()
                    with ours, theirs:  # it opens the ports, finds that nobody uses them, and insists
                        for request in list(self.lent.values()):
                            self._ask(ours, request.replace(" 0 ", " 1 ", 1)).close()
            return self._why or None

    def _beat(self, supervisor: subprocess.Popen[bytes]) -> None:
        """Signs of life, as long as this supervisor is in charge; one that is stopped is replaced."""
        signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)  # they are to interrupt what the main thread waits for
        while supervisor is self._supervisors[-1] and self.why_dark() is None:
            if stopped(supervisor.pid):
                supervisor.kill()  # it holds the ports
                supervisor.wait()
            with suppress(OSError):
                self._ours.send(BEAT)
            time.sleep(BEAT_S)

    def give_back(self, port: SupervisedPort, host: socket.socket) -> None:
        """Have a device made dark; returns when it has confirmed that, or its supervisor goes on alone."""
        why, end = self.why_dark(), time.monotonic() + END_S
        with suppress(OSError):
            host.shutdown(socket.SHUT_WR)
        with host, suppress(OSError):
            while select.select([host], [], [], max(0.0, end - time.monotonic()))[0] and host.recv(4096):
                pass
        if why is not None:
            with suppress(subprocess.TimeoutExpired):
                self._supervisors[-1].wait(max(0.0, end - time.monotonic()))
        with self._lock:
            self.lent.pop(port, None)

    def keep(self, port: SupervisedPort, request: str) -> None:
        """A port is open: the supervisor after one that was killed is to make its device dark."""
        with self._lock:
            self.lent[port] = request


LIFELINE = Lifeline()


def require_supervisor() -> None:
    """Refuse to let light out, or to trust an image, after everything was made dark. Raises: SwitchedOff."""
    if LIFELINE.lent and (why := LIFELINE.why_dark()):
        raise SwitchedOff("supervisor", "the rig", f"is dark: {why}", REMEDY)


class SupervisedPort(SerialBase):
    """The program's end of a port that is lent to it."""

    _host: socket.socket | None = None

    def open(self) -> None:
        """Have it opened: its device is told to be dark by that."""
        kind = str(self.port).removeprefix(PREFIX).partition(":")[0]
        if kind not in KINDS:
            raise SerialException(f"{kind!r} is no kind of device that is supervised: {', '.join(KINDS)}")
        urls, end = _in_numbers(port_of(str(self.port))), time.monotonic() + IN_USE_S
        while True:
            request = f"{kind} {self.baudrate} 0 {urls[0]}"
            host = LIFELINE.lend(request)
            try:
                said = host.recv(1)  # what follows READY is the device's
                if said == READY:
                    break
                said += host.recv(256)
            except OSError as error:
                said = str(error).encode()
            except BaseException:
                host.close()
                raise
            host.close()
            if urls[1:]:
                urls = urls[1:]  # `localhost` may be ::1 first, and its server on 127.0.0.1 alone
                continue
            if b"exclusively" not in said or time.monotonic() > end:
                raise SerialException(said.decode(errors="replace") or "the supervisor did not start")
            time.sleep(BEAT_S)
        self._host, self.is_open = host, True
        LIFELINE.keep(self, request)

    def close(self) -> None:
        """Make the device dark and give the port back; a second time does nothing."""
        if self._host is not None:
            host, self._host, self.is_open = self._host, None, False
            LIFELINE.give_back(self, host)

    def leave(self) -> None:
        """Forget the port, which is another process's, without closing it for that one."""
        if self._host is not None:
            self._host.close()
        self._host, self.is_open = None, False

    def _open_host(self) -> socket.socket:
        if self._host is None:
            raise PortNotOpenError
        return self._host

    def _gone(self, error: Exception | None = None) -> GoneDark:
        return GoneDark(LIFELINE.why_dark() or f"the supervisor has closed it ({error or 'no more bytes'})")

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read without waiting."""
        count = array.array("i", [0])
        try:
            fcntl.ioctl(self._open_host(), termios.FIONREAD, count)
        except OSError as error:
            raise SerialException(str(error)) from error
        return int(count[0])

    def read(self, size: int = 1, /) -> bytes:
        """At most `size` bytes within the port's timeout."""
        host = self._open_host()
        try:
            if not select.select([host], [], [], self.timeout)[0]:
                return b""
            data = host.recv(size)
        except OSError as error:
            raise self._gone(error) from error
        if not data:
            raise self._gone()
        return data

    def write(self, data: bytes, /) -> int:  # type: ignore[override]
        """Hand over all bytes."""
        host = self._open_host()
        try:
            host.settimeout(self.write_timeout)
            host.sendall(data)
        except TimeoutError as error:
            raise SerialTimeoutException("the supervisor takes no bytes") from error
        except OSError as error:
            raise self._gone(error) from error
        return len(data)


def serial_class_for_url(url: str) -> tuple[str, type[SupervisedPort]]:
    """What `serial.serial_for_url` asks a handler for."""
    return url, SupervisedPort
