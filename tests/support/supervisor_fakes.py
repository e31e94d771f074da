"""A laser of a few lines behind a terminal, programs that use it, and an end to whatever a test has started."""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress

import pytest

from hw.base.clock import WallClock
from hw.safety.ports.protocol_supervised import LIFELINE, SupervisedPort
from hw.safety.supervised_device import READY
from hw.safety.supervisor import LEND, Supervisor
from hw.serial.link import Link

LIMIT_S = 1.0  # on a busy machine; the benchmark measures the 100 ms


class Laser:
    """Answers `?LOn`, `?LOf`, `?GAS` and sets; `went_off` is the time at which emission last ended."""

    def __init__(self, on: bool = False, deaf: int = 0) -> None:
        self.on, self.deaf, self.went_off = on, deaf, 0.0
        self.late_s = 0.0  # before every answer
        self.preheats = self.refusals = 0  # questions answered so, and LOf that are refused
        self.said: list[str] = []
        self.master, self._keep = pty.openpty()  # the slave stays open, or a reconnecting program meets an error
        tty.setraw(self.master)
        self.port = os.ttyname(self._keep)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        line = b""
        while not self._ended.is_set():
            if not select.select([self.master], [], [], 0.01)[0]:
                continue
            line += os.read(self.master, 256)
            while b"\r" in line:
                command, line = line.split(b"\r", 1)
                self._do(command)

    def _do(self, command: bytes) -> None:
        found = re.match(rb"\?([A-Za-z]{3})", command)  # what is left of another command spoils it, as in a real laser
        if found is None:
            return
        letters = found.group(1).decode()
        self.said.append(letters)
        if letters == "LOf" and self.deaf > 0:
            self.deaf -= 1
            return
        if letters == "LOf" and self.refusals > 0:
            self.refusals -= 1
            os.write(self.master, b"!LOfx\r")
            return
        if letters in ("LOn", "LOf"):
            if self.on and letters == "LOf":
                self.went_off = time.monotonic()
            self.on = letters == "LOn"
        preheats = letters == "GAS" and self.preheats > 0
        self.preheats -= preheats
        status = f"{0x200 | 4 * preheats | 2 * self.on:04X}"
        answer = status if letters == "GAS" else ">"
        time.sleep(self.late_s)
        for piece in (f"\0!{letters[:2]}$note\r\0{letters[2:]}", f"{answer}\r"):  # as broken as it may be
            os.write(self.master, piece.encode())
            time.sleep(0.005)

    def close(self) -> None:
        if self._ended.is_set():
            return
        self._ended.set()
        self._thread.join()
        os.close(self.master)
        os.close(self._keep)


@pytest.fixture
def laser(lasers: Callable[..., Laser]) -> Laser:
    return lasers()


def wait(laser: Laser, on: bool, limit_s: float = 5.0) -> None:
    end = time.monotonic() + limit_s
    while laser.on is not on:
        assert time.monotonic() < end, f"the laser did not turn {'on' if on else 'off'}"
        time.sleep(0.002)


def said_by(port: SupervisedPort) -> bytes:
    """Its next answer, without the CR."""
    got, end = b"", time.monotonic() + 2.0
    while not (plain := re.sub(rb"\$[^\r]*\r|\0", b"", got)).endswith(b"\r"):
        assert time.monotonic() < end, got
        got += port.read(1)  # what follows is another answer's
    return plain[:-1]


PROGRAM = """
import signal, sys, threading, time
from hw.safety.ports.protocol_supervised import SupervisedPort
port = SupervisedPort("supervised://laser:" + sys.argv[1], baudrate=500000, timeout=0.5, write_timeout=1)
port.write(b"?LOn\\r")
if sys.argv[2] == "deaf":  # a main thread that never gets to its signal handlers: one long step of C
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, lambda *_: sys.exit())
    print("on", flush=True)
    sum(range(2 * 10**9))
elif sys.argv[2] == "exception":
    print("on", flush=True)
    sys.stdin.readline()
    raise RuntimeError("end")
elif sys.argv[2] == "fork":
    import os
    if os.fork() == 0:
        time.sleep(3)  # inherits the socket and outlives its parent
        os._exit(0)
    print("on", flush=True)
    time.sleep(30)
else:
    print("on", flush=True)
    sys.stdin.readline()
"""


Run = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def run() -> Iterator[Run]:
    """Programs in a session of their own; none outlives its test, and no pipe of one that failed is left to the next.

    What is left open is closed whenever Python gets to it, and then complains into whatever test is running.
    """
    started: list[subprocess.Popen[str]] = []

    def start(laser: Laser | None, how: str, text: str = PROGRAM) -> subprocess.Popen[str]:
        program = subprocess.Popen(
            [sys.executable, "-c", text, *([] if laser is None else [laser.port]), how], start_new_session=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        started.append(program)
        assert program.stdout is not None and program.stdout.readline() == "on\n"
        if laser is not None:
            wait(laser, on=True)
        return program

    yield start
    for program in started:
        with program:  # closes its pipes
            program.kill()
        for supervisor in supervisors_of(program.pid):
            with suppress(ProcessLookupError):
                os.kill(supervisor, signal.SIGKILL)


@pytest.fixture
def lasers() -> Iterator[Callable[..., Laser]]:
    """Lasers that end with the test, whatever becomes of it, and their supervisors with them.

    One that its laser never answered goes on for ten minutes, and would meet the next test's terminal under the same
    name: it would lock it, and say LOf into it.
    """
    made: list[Laser] = []

    def make(on: bool = False, deaf: int = 0) -> Laser:
        made.append(Laser(on, deaf))
        return made[-1]

    yield make
    end_supervisors()
    for laser in made:
        laser.close()


Opening = Callable[[Laser], SupervisedPort]


@pytest.fixture
def ports() -> Iterator[Opening]:
    """Opens supervised ports, and closes those that a test that fails leaves open."""
    with ExitStack() as left:

        def open_port(laser: Laser) -> SupervisedPort:
            port = SupervisedPort("supervised://laser:" + laser.port, baudrate=500000, timeout=0.5, write_timeout=1)
            left.callback(port.close)
            return port

        yield open_port


@pytest.fixture
def link(laser: Laser) -> Iterator[Link]:
    """A supervised link to the laser."""
    made = Link("supervised://laser:" + laser.port, 500000, "laser 635 nm", WallClock())
    yield made
    made.close()


@contextmanager
def serving(port: str) -> Iterator[tuple[socket.socket, socket.socket, threading.Thread]]:
    """A supervisor in a thread: its lifeline, the socket of one port that is lent, and the thread."""
    (ours, theirs), (host, lent) = socket.socketpair(), socket.socketpair()
    thread = threading.Thread(target=Supervisor(theirs, os.getppid()).run)
    with ours, theirs, host:
        host.send(f"laser 500000 0 {port}".encode())
        socket.send_fds(ours, [LEND], [lent.fileno()])
        lent.close()
        thread.start()
        assert host.recv(1) == READY
        yield ours, host, thread
        ours.close()
        thread.join(5.0)
        assert not thread.is_alive()


def supervisors_of(program: int) -> list[int]:
    """The supervisors of a program, whether it has ended or not: the number of its process is in their command."""
    found = subprocess.run(["ps", "-ww", "-eo", "pid=,args="], capture_output=True, text=True, check=True)
    lines = [line.split() for line in found.stdout.splitlines() if "-m hw.safety.supervisor " in line]
    return [int(own) for own, *words in lines if words[-1] == str(program)]


def end_supervisors() -> None:
    """End those of this process, also one that still insists."""
    for supervisor in LIFELINE._supervisors:
        supervisor.terminate()
        with suppress(subprocess.TimeoutExpired):
            supervisor.wait(0.3)
        supervisor.kill()
        supervisor.wait()
