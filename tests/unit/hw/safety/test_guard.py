"""The guard: the laser is off after every way in which a program can end, and before anything is said.

The laser here is a few lines behind a pty; `python -m benchmarks laser-safety` uses the emulated firmware.
"""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Callable

import pytest
import serial
from guard_fakes import LIMIT_S, Laser, Opening, Run, guards_of, said_by, wait

from hw.base.errors import SwitchedOff
from hw.safety import guard
from hw.safety.guard import GuardClosed
from hw.safety.ports import protocol_guard
from hw.safety.ports.protocol_guard import GuardedPort
from hw.serial.link import Link


@pytest.mark.timing
def test_opening_switches_off_before_anything_is_said_and_closing_does_again(
    lasers: Callable[..., Laser], ports: Opening
) -> None:
    laser = lasers(on=True)
    port = ports(laser)
    assert not laser.on  # by the time that the port is open
    assert laser.said[0] == "LOf"
    time.sleep(0.1)
    assert port.in_waiting == 0  # the guard keeps the answers to its own commands
    port.write(b"?LOn\r")
    wait(laser, on=True)
    assert said_by(port) == b"!LOn>"
    begun = time.monotonic()
    port.close()
    assert laser.went_off - begun < LIMIT_S
    assert not laser.on and laser.said[-1] == "GAS"  # it was asked whether it is off
    assert laser.said[-2] == "SAS" and "TPP" in laser.said  # no autostart, no power: it stays off


@pytest.mark.timing
@pytest.mark.parametrize(
    "number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT], ids=lambda n: n.name
)
def test_off_after_a_signal(laser: Laser, run: Run, number: signal.Signals) -> None:
    program = run(laser, "wait")
    begun = time.monotonic()
    program.send_signal(number)
    wait(laser, on=False)
    assert laser.went_off - begun < LIMIT_S
    program.communicate()


@pytest.mark.timing
@pytest.mark.parametrize("how", ["SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "fork"])
def test_off_though_the_main_thread_is_busy_or_a_child_keeps_the_socket(laser: Laser, run: Run, how: str) -> None:
    program = run(laser, "fork" if how == "fork" else "deaf")
    begun = time.monotonic()
    program.send_signal(signal.SIGKILL if how == "fork" else signal.Signals[how])
    wait(laser, on=False)
    assert laser.went_off - begun < LIMIT_S
    program.kill()
    program.communicate()


@pytest.mark.timing
@pytest.mark.parametrize("how", ["exception", "exit"])
def test_off_at_the_end_of_the_program(laser: Laser, run: Run, how: str) -> None:
    program = run(laser, how)
    begun = time.monotonic()
    program.communicate("\n")
    wait(laser, on=False, limit_s=3)
    assert program.returncode == (how == "exception")
    assert begun < laser.went_off < begun + 3 and laser.said.index("LOn") < len(laser.said) - 1


def test_it_insists_until_the_laser_confirms(lasers: Callable[..., Laser], ports: Opening) -> None:
    laser = lasers(deaf=9)
    port = ports(laser)
    port.write(b"?LOn\r")
    wait(laser, on=True)
    port.close()
    wait(laser, on=False)
    assert laser.deaf == 0


@pytest.mark.parametrize("what", ["preheats", "refusals"])
def test_a_laser_that_preheats_or_refuses_is_not_taken_for_off(laser: Laser, ports: Opening, what: str) -> None:
    port = ports(laser)
    port.write(b"?GAS\r")
    port.read(64)
    setattr(laser, what, 4)
    laser.said.clear()
    port.close()
    assert getattr(laser, what) == 0 and laser.said.count("LOf") >= 5 and laser.said[-1] == "GAS"


STOPPED = """
import sys
from hw.base.clock import WallClock
from hw.base.errors import DiscoError
from hw.serial.link import Link
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


@pytest.mark.timing
@pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="the state of a process is read in /proc")
@pytest.mark.parametrize("number", [signal.SIGSTOP])  # the kernel drops SIGTSTP where no shell could continue it
def test_off_while_the_program_is_stopped_which_says_so_when_it_continues(
    laser: Laser, run: Run, number: signal.Signals
) -> None:
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


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_guard_that_is_killed_or_stopped_is_noticed_and_the_laser_goes_off(
    laser: Laser, link: Link, number: signal.Signals
) -> None:
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


@pytest.mark.parametrize("number", sorted(guard.ENDING), ids=lambda n: n.name)
def test_a_guard_that_is_told_to_end_switches_off_first(laser: Laser, link: Link, number: signal.Signals) -> None:
    link.write(b"?LOn\r")
    wait(laser, on=True)
    os.kill(guards_of(os.getpid())[0], number)
    wait(laser, on=False)
    with pytest.raises(SwitchedOff, match="its guard has closed it"):
        link.require_guard()


def test_a_port_that_does_not_exist_is_an_error_of_opening() -> None:
    with pytest.raises(serial.SerialException, match="No such file"):
        GuardedPort("guard:///dev/disco-no-such-port", baudrate=500000, timeout=0.5)


def test_a_dead_port_says_so(laser: Laser, ports: Opening) -> None:
    port = ports(laser)
    port.trip()
    with pytest.raises(GuardClosed, match="its guard has closed it"):
        port.write(b"?GAS\r")
    with pytest.raises(GuardClosed, match="its guard has closed it"):
        port.read(1)


def test_a_stop_or_kill_of_the_whole_foreground_group_does_not_reach_the_guard(laser: Laser, run: Run) -> None:
    """Ctrl-Z and `kill -9 -GROUP` go to every process of the program's group: the guard is in none of them."""
    program = run(laser, "wait", STOPPED)
    (own,) = guards_of(program.pid)
    os.killpg(program.pid, signal.SIGSTOP)
    try:
        wait(laser, on=False)
    finally:
        os.killpg(program.pid, signal.SIGCONT)
    assert os.getpgid(own) != program.pid
    other = run(laser, "wait")
    os.killpg(other.pid, signal.SIGKILL)
    wait(laser, on=False)


def test_guard_and_program_killed_together_leave_it_on_until_the_next_connection(
    laser: Laser, run: Run, ports: Opening
) -> None:
    """What docs/lab.md says that only hardware covers: so it is, and connecting again ends it."""
    program = run(laser, "wait")
    (own,) = guards_of(program.pid)
    for victim, number in ((own, signal.SIGSTOP), (program.pid, signal.SIGKILL), (own, signal.SIGKILL)):
        os.kill(victim, number)
    program.wait()
    time.sleep(0.5)
    assert laser.on
    ports(laser)
    assert not laser.on


@pytest.mark.timing
def test_every_guard_sees_the_signal(lasers: Callable[..., Laser], run: Run) -> None:
    """Three lasers, three guards, one signal, and a main thread that never gets to it."""
    three = [lasers() for _ in range(3)]
    program = run(three[0], ",".join(laser.port for laser in three[1:]), THREE)
    for laser in three:
        wait(laser, on=True)
    begun = time.monotonic()
    program.send_signal(signal.SIGTERM)
    for laser in three:
        wait(laser, on=False, limit_s=2 * LIMIT_S)
    assert program.poll() is None  # it has not got to its handler
    assert all(begun < laser.went_off < begun + 2 * LIMIT_S for laser in three)


THREE = """
import signal, sys
from hw.safety.ports import protocol_guard
from hw.safety.ports.protocol_guard import GuardedPort
signal.signal(signal.SIGTERM, lambda *_: sys.exit())
names = [sys.argv[1], *sys.argv[2].split(",")]
ports = [GuardedPort("guard://" + name, baudrate=500000, timeout=0.5, write_timeout=1) for name in names]
for port in ports:
    port.write(b"?LOn\\r")
print("on", flush=True)
sum(range(2 * 10**9))
"""


def test_ctrl_c_while_a_guard_starts_leaves_none_counted(
    laser: Laser, ports: Opening, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A notebook goes on: with one guard too many, the next laser would be switched off by the signal of before."""
    before = protocol_guard._SIGNALS.guards

    def interrupted(self: socket.socket, size: int) -> bytes:
        raise KeyboardInterrupt

    started = []
    start = GuardedPort._start

    class Interrupted(socket.socket):
        recv = interrupted  # type: ignore[assignment]

    def spied(self: GuardedPort) -> socket.socket:
        ours = start(self)
        started.append(self._guard)
        return Interrupted(fileno=ours.detach())

    monkeypatch.setattr(GuardedPort, "_start", spied)
    with pytest.raises(KeyboardInterrupt):
        ports(laser)
    assert protocol_guard._SIGNALS.guards == before
    assert started[0] is not None and started[0].poll() is not None  # ended, and waited for
