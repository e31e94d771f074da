"""pyserial's handler of `guard://PORT`: a port that belongs to a guard process (`hw.safety.guard`), for lasers.

Closing it, or ending in any way, switches the laser off. A signal that would end the program switches it off at once,
even while the main thread is held up in a library or by the disk.
"""

from __future__ import annotations

import array
import atexit
import contextlib
import fcntl
import logging
import os
import select
import signal
import socket
import subprocess
import termios
import threading

from serial import PortNotOpenError, SerialBase, SerialException, SerialTimeoutException

from hw.base.children import child_environment, module_command
from hw.safety.guard import IS_OFF, OFF_AS_STOPPED, READY, UNCONFIRMED, GuardClosed, stopped

log = logging.getLogger(__name__)

PREFIX = "guard://"
START_S = 10.0  # a guard is a Python process
END_S = 8.0  # it insists on an answer of the laser
ENDING_S = 0.3  # from the end of its socket to its own


class _Signals:
    """The numbers of the signals that the program receives, where guards can look at them.

    Python runs a signal's handler in the main thread between two of its steps: too late for a laser where that thread
    waits for the disk or is inside a long computation. The signal's number, however, is written to a descriptor at
    once. Signals that the program ignores are not.
    """

    def __init__(self) -> None:
        self._pair: tuple[socket.socket, socket.socket] | None = None
        self._lock = threading.Lock()  # lasers are closed side by side
        self.guards = 0  # that look

    def count(self, more: int) -> None:
        """So many guards more look, or fewer."""
        with self._lock:
            self.guards += more

    def reader(self) -> int:
        """The descriptor to look at."""
        if self._pair is None:
            self._pair = socket.socketpair()
            for end in self._pair:
                end.setblocking(False)
                atexit.register(end.close)
        reader, writer = self._pair
        if threading.current_thread() is threading.main_thread():
            signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        if not self.guards:
            with contextlib.suppress(BlockingIOError):
                reader.recv(4096)  # signals of before concern no laser that is opened now
        return reader.fileno()


_SIGNALS = _Signals()


def _hung_up(host: socket.socket) -> bool:
    """Whether the other end is closed, though bytes that it sent may still be unread."""
    poll = select.poll()
    poll.register(host, 0)  # hanging up is always reported
    return bool(poll.poll(0))


class GuardedPort(SerialBase):
    """The program's end of a guarded port."""

    _host: socket.socket | None = None
    _guard: subprocess.Popen[bytes] | None = None
    _rescued = False  # the guard was found dead or stopped, and the laser is being switched off without it

    def open(self) -> None:
        """Start the guard, which opens the port and switches off."""
        self._rescued = False
        self._host = self._start()
        _SIGNALS.count(1)
        self._host.settimeout(START_S)
        try:
            said = self._host.recv(1)  # what follows READY is the laser's
            if said != READY:
                said += self._host.recv(256)
        except OSError as error:
            said = str(error).encode()
        except BaseException:  # Ctrl-C: a guard that is still counted would keep old signals for the next one
            self._end()
            raise
        if said != READY:
            self._end()
            raise SerialException(said.decode(errors="replace") or "the guard process did not start")
        self.is_open = True

    def _start(self) -> socket.socket:
        """Start a guard, whose first word switches the laser off; our end of its socket."""
        url = str(self.port).removeprefix(PREFIX)
        ours, theirs = socket.socketpair()
        shared = [theirs.fileno(), _SIGNALS.reader()]
        options = [url, str(self.baudrate), *map(str, shared), str(os.getpid())]
        command = module_command("hw.safety.guard", *options)
        try:
            with theirs:
                self._guard = subprocess.Popen(
                    command, pass_fds=shared, env=child_environment(), stdin=subprocess.DEVNULL, start_new_session=True
                )
        except BaseException:
            ours.close()
            raise
        return ours

    def gone(self, wait_s: float = ENDING_S) -> str | None:
        """Why no guard looks after the laser any more, or None: asked before every image. It is switched off then.

        wait_s: how long a guard that has closed its socket is given to end, and so to say why.
        """
        guard, host = self._guard, self._host
        if guard is None or host is None:
            return "it is closed"
        if self._rescued:
            return "its guard process ended"
        if guard.poll() is None:
            if stopped(guard.pid):
                self._rescue(guard)
                return "its guard process was stopped, and continues so as to switch the laser off"
            if not _hung_up(host):
                return None
            with contextlib.suppress(subprocess.TimeoutExpired):  # it is still switching off
                guard.wait(wait_s)
        if guard.returncode == OFF_AS_STOPPED:
            return "the program was stopped (Ctrl-Z or SIGSTOP), and the laser switched off for that time"
        if guard.returncode == UNCONFIRMED:
            return "its guard has closed it, and THE LASER HAS NOT CONFIRMED THAT IT IS OFF: open its interlock"
        if guard.returncode in (None, IS_OFF):
            return "its guard has closed it: the laser was switched off, or its cable pulled"
        status = guard.returncode
        self._rescue(guard)
        return f"its guard process was killed (status {status}); another one switches the laser off"

    def _rescue(self, guard: subprocess.Popen[bytes]) -> None:
        """The guard cannot act: have the laser switched off by it or by another, without waiting for that."""
        self._rescued = True
        log.warning("%s: its guard was stopped or killed: switching the laser off", self.port)
        self.trip()
        if guard.poll() is None:
            guard.send_signal(signal.SIGCONT)
        else:
            self._start().close()  # it finds nobody, and insists on an answer of the laser before it ends

    def close(self) -> None:
        """End the guard, which switches the laser off; a second time does nothing."""
        if self.is_open:
            self.is_open = False
            self._end()

    def trip(self) -> None:
        """Have the laser switched off now; the port is dead from here on. Any thread."""
        with contextlib.suppress(OSError):  # it is dead already
            if self._host is not None:
                self._host.shutdown(socket.SHUT_RDWR)

    def _end(self) -> None:
        if self._guard is not None and not self._rescued:
            self.gone(wait_s=0.0)
        self.trip()
        if self._host is not None:
            self._host.close()
            _SIGNALS.count(-1)
        if self._guard is not None:
            try:
                self._guard.wait(END_S)
            except subprocess.TimeoutExpired:
                log.info("%s: the guard is still switching off", self.port)  # it reports the end itself
        self._host = self._guard = None

    def _open_host(self) -> socket.socket:
        if self._host is None:
            raise PortNotOpenError
        return self._host

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
            raise GuardClosed(self.gone(0.0) or f"its guard has closed it: {error.strerror}") from error
        if not data:
            raise GuardClosed(self.gone(0.0) or "its guard has closed it")
        return data

    def write(self, data: bytes, /) -> int:  # type: ignore[override]
        """Hand over all bytes."""
        host = self._open_host()
        try:
            host.settimeout(self.write_timeout)
            host.sendall(data)
        except TimeoutError as error:
            raise SerialTimeoutException("the guard takes no bytes") from error
        except OSError as error:
            raise GuardClosed(self.gone(0.0) or f"its guard has closed it: {error.strerror}") from error
        return len(data)


def serial_class_for_url(url: str) -> tuple[str, type[GuardedPort]]:
    """What `serial.serial_for_url` asks a handler for."""
    return url, GuardedPort
