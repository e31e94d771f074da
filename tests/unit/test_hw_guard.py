"""The guard: the laser is off after every way in which a program can end, and before anything is said.

The laser here is a few lines behind a pty; `python -m benchmarks laser-safety` uses the emulated firmware.
"""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator

import pytest
import serial

from hw import guard
from hw.clock import WallClock
from hw.errors import SwitchedOff
from hw.guard import GuardClosed
from hw.ports.protocol_guard import Serial
from hw.serial_link import Link

LIMIT_S = 1.0  # on a busy machine; the benchmark measures the 100 ms


class Laser:
    """Answers `?LOn`, `?LOf`, `?GAS` and sets; `went_off` is the time at which emission last ended."""

    def __init__(self, on: bool = False, deaf: int = 0) -> None:
        self.on, self.deaf, self.went_off = on, deaf, 0.0
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
        found = re.search(rb"\?([A-Za-z]{3})", command)
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
        os.write(self.master, f"\0$note\r!{letters}{answer}\r".encode())

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        os.close(self.master)
        os.close(self._keep)


@pytest.fixture
def laser() -> Iterator[Laser]:
    device = Laser()
    yield device
    device.close()


def wait(laser: Laser, on: bool, limit_s: float = 5.0) -> None:
    end = time.monotonic() + limit_s
    while laser.on is not on:
        assert time.monotonic() < end, f"the laser did not turn {'on' if on else 'off'}"
        time.sleep(0.002)


def opened(laser: Laser) -> Serial:
    return Serial("guard://" + laser.port, baudrate=500000, timeout=0.5, write_timeout=1)


PROGRAM = """
import signal, sys, threading, time
from hw.guard import GuardClosed
from hw.ports.protocol_guard import Serial
port = Serial("guard://" + sys.argv[1], baudrate=500000, timeout=0.5, write_timeout=1)
port.write(b"?LOn\\r")
if sys.argv[2] == "deaf":  # a main thread that never gets to its signal handlers: one long step of C
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
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


def run(laser: Laser, how: str, text: str = PROGRAM) -> subprocess.Popen[str]:
    program = subprocess.Popen(
        [sys.executable, "-c", text, laser.port, how],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert program.stdout is not None and program.stdout.readline() == "on\n"
    wait(laser, on=True)
    return program


def test_opening_switches_off_before_anything_is_said_and_closing_does_again() -> None:
    laser = Laser(on=True)
    try:
        port = opened(laser)
        wait(laser, on=False, limit_s=LIMIT_S)
        assert laser.said[0] == "LOf"
        assert port.in_waiting == 0  # the guard keeps the answers to its own commands
        port.write(b"?LOn\r")
        wait(laser, on=True)
        assert b"!LOn>" in port.read(64)
        begun = time.monotonic()
        port.close()
        assert laser.went_off - begun < LIMIT_S
        assert not laser.on and laser.said[-1] == "GAS"  # it was asked whether it is off
    finally:
        laser.close()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_off_after_a_signal(laser: Laser, number: signal.Signals) -> None:
    program = run(laser, "wait")
    begun = time.monotonic()
    program.send_signal(number)
    wait(laser, on=False)
    assert laser.went_off - begun < LIMIT_S
    program.communicate()


@pytest.mark.parametrize("how", ["deaf", "fork"])
def test_off_though_the_main_thread_is_busy_or_a_child_keeps_the_socket(laser: Laser, how: str) -> None:
    program = run(laser, how)
    begun = time.monotonic()
    program.send_signal(signal.SIGTERM if how == "deaf" else signal.SIGKILL)
    wait(laser, on=False)
    assert laser.went_off - begun < LIMIT_S
    program.kill()
    program.communicate()


@pytest.mark.parametrize("how", ["exception", "exit"])
def test_off_at_the_end_of_the_program(laser: Laser, how: str) -> None:
    program = run(laser, how)
    program.communicate("\n")
    wait(laser, on=False, limit_s=3)


def test_it_insists_until_the_laser_confirms() -> None:
    laser = Laser(deaf=9)
    try:
        port = opened(laser)
        port.write(b"?LOn\r")
        wait(laser, on=True)
        port.close()
        wait(laser, on=False)
        assert laser.deaf == 0
    finally:
        laser.close()


@pytest.mark.parametrize("what", ["preheats", "refusals"])
def test_a_laser_that_preheats_or_refuses_is_not_taken_for_off(laser: Laser, what: str) -> None:
    port = opened(laser)
    port.write(b"?GAS\r")
    port.read(64)
    setattr(laser, what, 4)
    laser.said.clear()
    port.close()
    assert getattr(laser, what) == 0 and laser.said.count("LOf") >= 5 and laser.said[-1] == "GAS"


STOPPED = """
import sys
from hw.clock import WallClock
from hw.errors import DiscoError
from hw.serial_link import Link
link = Link("guard://" + sys.argv[1], 500000, "laser 635 nm", WallClock())
link.write(b"?LOn\\r")
link.require_guard()
print("on", flush=True)
sys.stdin.readline()
try:
    link.require_guard()
except DiscoError as error:
    print(error, flush=True)
"""


@pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="the state of a process is read in /proc")
@pytest.mark.parametrize("number", [signal.SIGSTOP])  # the kernel drops SIGTSTP where no shell could continue it
def test_off_while_the_program_is_stopped_which_says_so_when_it_continues(laser: Laser, number: signal.Signals) -> None:
    program = run(laser, "wait", STOPPED)
    begun = time.monotonic()
    program.send_signal(number)
    try:
        wait(laser, on=False)
    finally:
        program.send_signal(signal.SIGCONT)
    assert laser.went_off - begun < LIMIT_S
    said, complaint = program.communicate("\n")
    assert "laser 635 nm is closed: the program was stopped (Ctrl-Z" in said and "Remedy" in said, complaint


def guards_of(pid: int) -> list[int]:
    found = subprocess.run(["ps", "-o", "pid=,args=", "--ppid", str(pid)], capture_output=True, text=True, check=True)
    return [int(line.split()[0]) for line in found.stdout.splitlines() if "hw.guard" in line]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_guard_that_is_killed_or_stopped_is_noticed_and_the_laser_goes_off(
    laser: Laser, number: signal.Signals
) -> None:
    link = Link("guard://" + laser.port, 500000, "laser 635 nm", WallClock())
    link.write(b"?LOn\r")
    wait(laser, on=True)
    link.require_guard()
    (victim,) = guards_of(os.getpid())
    os.kill(victim, number)
    end = time.monotonic() + 5.0
    while not guard.stopped(victim) and number == signal.SIGSTOP:
        assert time.monotonic() < end
    if number == signal.SIGKILL:
        os.waitid(os.P_PID, victim, os.WEXITED | os.WNOWAIT)
    with pytest.raises(SwitchedOff, match=r"laser 635 nm is closed: its guard process was (killed|stopped)"):
        link.require_guard()
    wait(laser, on=False)  # by the guard that continues, or by another, before anything else is asked for
    with pytest.raises(SwitchedOff, match="its guard process ended"):
        link.require_guard()
    link.close()
    assert laser.said[-1] == "GAS"


def test_a_guard_that_is_told_to_end_switches_off_first(laser: Laser) -> None:
    link = Link("guard://" + laser.port, 500000, "laser", WallClock())
    link.write(b"?LOn\r")
    wait(laser, on=True)
    os.kill(guards_of(os.getpid())[0], signal.SIGTERM)
    wait(laser, on=False)
    with pytest.raises(SwitchedOff, match="its guard has closed it"):
        link.require_guard()
    link.close()


def test_a_port_that_does_not_exist_is_an_error_of_opening() -> None:
    with pytest.raises(serial.SerialException, match="No such file"):
        Serial("guard:///dev/disco-no-such-port", baudrate=500000, timeout=0.5)


def test_a_dead_port_says_so(laser: Laser) -> None:
    port = opened(laser)
    port.trip()
    with pytest.raises(GuardClosed, match="its guard has closed it"):
        port.write(b"?GAS\r")
    with pytest.raises(GuardClosed, match="its guard has closed it"):
        port.read(1)
    port.close()
