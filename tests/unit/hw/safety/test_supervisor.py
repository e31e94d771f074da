"""The supervisor: everything is dark after every way in which a program can end, and before anything is said.

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
from capture_fakes import fork
from supervisor_fakes import LIMIT_S, Laser, Opening, Run, said_by, supervisors_of, wait

from hw.base.errors import SwitchedOff
from hw.safety.darkness import KINDS
from hw.safety.ports.protocol_supervised import LIFELINE, GoneDark, Lifeline, SupervisedPort, require_supervisor
from hw.safety.signals import ENDING
from hw.safety.supervisor import LEND, Supervisor
from hw.serial.link import Link


@pytest.mark.timing
def test_opening_switches_off_before_anything_is_said_and_closing_does_again(
    lasers: Callable[..., Laser], ports: Opening
) -> None:
    laser = lasers(on=True)
    port = ports(laser)
    port.write(b"?LOn\r")
    assert said_by(port) == b"!LOf>" and laser.said[0] == "LOf"
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
    said_by(port)  # to the LOf of opening it
    setattr(laser, what, 4)
    laser.said.clear()
    port.close()
    assert getattr(laser, what) == 0 and laser.said.count("LOf") >= 5 and laser.said[-1] == "GAS"


STOPPED = """
import sys
from hw.base.clock import WallClock
from hw.base.errors import DiscoError
from hw.safety.ports.protocol_supervised import require_supervisor
from hw.serial.link import Link
link = Link("supervised://laser:" + sys.argv[1], 500000, "laser 635 nm", WallClock())
link.write(b"?LOn\\r")
require_supervisor()
print("on", flush=True)
sys.stdin.readline()
try:
    require_supervisor()
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
    assert "the rig is dark: the program was stopped (Ctrl-Z" in said and "Remedy" in said, complaint


@pytest.mark.timing
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_supervisor_that_is_killed_or_stopped_is_replaced_by_one_that_makes_everything_dark(
    laser: Laser, link: Link, number: signal.Signals
) -> None:
    """Nobody asks for anything meanwhile: the program is in a long exposure."""
    link.write(b"?LOn\r")
    wait(laser, on=True)
    require_supervisor()
    begun = time.monotonic()
    os.kill(LIFELINE._supervisors[-1].pid, number)
    wait(laser, on=False)
    assert laser.went_off - begun < LIMIT_S
    with pytest.raises(SwitchedOff, match=r"the rig is dark: its supervisor was killed or stopped .*Remedy"):
        require_supervisor()
    with pytest.raises(SwitchedOff, match="supervisor was killed or stopped"):
        link.write(b"?GAS\r")
    link.close()
    assert laser.said[-1] == "GAS"
    require_supervisor()  # nothing is lent any more


@pytest.mark.parametrize("number", sorted(ENDING), ids=lambda n: n.name)
def test_a_supervisor_that_is_told_to_end_makes_everything_dark_first(
    laser: Laser, link: Link, number: signal.Signals
) -> None:
    link.write(b"?LOn\r")
    wait(laser, on=True)
    os.kill(LIFELINE._supervisors[-1].pid, number)
    wait(laser, on=False)
    with pytest.raises(SwitchedOff, match="the supervisor was told to end"):
        require_supervisor()


def test_a_port_that_does_not_exist_is_an_error_of_opening() -> None:
    with pytest.raises(serial.SerialException, match="No such file"):
        SupervisedPort("supervised://laser:/dev/disco-no-such-port", baudrate=500000, timeout=0.5)


def read_all(port: SupervisedPort) -> None:
    """What a laser had said before its port died can still be read."""
    while port.read(64):
        pass


def test_a_dead_port_says_so(laser: Laser, ports: Opening) -> None:
    port = ports(laser)
    LIFELINE._supervisors[-1].terminate()
    LIFELINE._supervisors[-1].wait(5.0)
    with pytest.raises(GoneDark, match="was told to end"):
        port.write(b"?GAS\r")
    with pytest.raises(GoneDark, match="was told to end"):
        read_all(port)


def test_a_stop_or_kill_of_the_whole_foreground_group_does_not_reach_it(laser: Laser, run: Run) -> None:
    """Ctrl-Z and `kill -9 -GROUP` go to every process of the program's group: the supervisor is in none of them."""
    program = run(laser, "wait", STOPPED)
    (own,) = supervisors_of(program.pid)
    os.killpg(program.pid, signal.SIGSTOP)
    try:
        wait(laser, on=False)
    finally:
        os.killpg(program.pid, signal.SIGCONT)
    assert os.getpgid(own) != program.pid
    other = run(laser, "wait")
    os.killpg(other.pid, signal.SIGKILL)
    wait(laser, on=False)


def test_supervisor_and_program_killed_together_leave_it_on_until_the_next_connection(
    laser: Laser, run: Run, ports: Opening
) -> None:
    """What docs/lab.md says that only hardware covers: so it is, and connecting again ends it."""
    program = run(laser, "wait")
    (own,) = supervisors_of(program.pid)
    for victim, number in ((own, signal.SIGSTOP), (program.pid, signal.SIGKILL), (own, signal.SIGKILL)):
        os.kill(victim, number)
    program.wait()
    time.sleep(0.5)
    assert laser.on
    ports(laser)
    wait(laser, on=False)


def test_what_was_asked_for_before_the_program_was_gone_is_made_dark(lasers: Callable[..., Laser]) -> None:
    """A supervisor in place of one that was killed may find the program gone before it has read what is to be dark."""
    two = [lasers(on=True) for _ in range(2)]
    program, lifeline = socket.socketpair()
    with program, lifeline:
        for laser in two:
            ours, theirs = socket.socketpair()
            with ours, theirs:
                ours.send(f"laser 500000 1 {laser.port}".encode())
                socket.send_fds(program, [LEND], [theirs.fileno()])
        Supervisor(lifeline, program=os.getpid()).run()  # not the parent of this process
    assert not any(laser.on for laser in two)


def test_one_that_does_not_confirm_is_no_end_of_the_others() -> None:
    """What comes over the lifeline says that everything is dark: a port that was closed alone is not told there."""
    program, lifeline = socket.socketpair()
    with program, lifeline:
        supervisor = Supervisor(lifeline, program=os.getppid())
        mute = Mute()
        supervisor._devices.append(mute)  # type: ignore[arg-type]
        supervisor._give_back(mute, confirmed=False)  # type: ignore[arg-type]
        program.setblocking(False)
        with pytest.raises(BlockingIOError):
            program.recv(1)


class Mute:
    """A device that was closed alone and does not confirm."""

    url, kind = "socket://nobody", KINDS["laser"]

    def __init__(self) -> None:
        self.host, other = socket.socketpair()
        other.close()

    def close(self) -> None:
        """Nothing to give back."""


@pytest.mark.timing
def test_every_laser_goes_off_though_one_is_mute(lasers: Callable[..., Laser], run: Run) -> None:
    """Three lasers, one signal, and a main thread that never gets to it; one laser neither obeys nor answers."""
    three = [lasers() for _ in range(3)]
    program = run(three[0], ",".join(laser.port for laser in three[1:]), THREE)
    for laser in three:
        wait(laser, on=True)
    three[0].deaf = 10**9
    begun = time.monotonic()
    program.send_signal(signal.SIGTERM)
    for laser in three[1:]:
        wait(laser, on=False)
    assert program.poll() is None  # it has not got to its handler
    assert all(begun < laser.went_off < begun + LIMIT_S for laser in three[1:])
    three[0].deaf = 0
    wait(three[0], on=False)


THREE = """
import signal, sys
from hw.safety.ports.protocol_supervised import SupervisedPort
signal.signal(signal.SIGTERM, lambda *_: sys.exit())
names = [sys.argv[1], *sys.argv[2].split(",")]
ports = [SupervisedPort("supervised://laser:" + name, baudrate=500000, timeout=0.5, write_timeout=1) for name in names]
for port in ports:
    port.write(b"?LOn\\r")
print("on", flush=True)
sum(range(2 * 10**9))
"""


@pytest.mark.timing
def test_a_program_that_hangs_goes_dark_though_nobody_tells_it_to_end(laser: Laser, run: Run) -> None:
    """It gives no sign of life: a step of C that keeps the interpreter, a machine that has no memory left."""
    program = run(laser, "deaf")
    wait(laser, on=False, limit_s=3.0 + LIMIT_S)
    program.kill()


def test_signals_to_a_forked_child_are_none_of_the_programs(laser: Laser, ports: Opening) -> None:
    """A pool of workers is ended by SIGTERM."""
    port = ports(laser)
    port.write(b"?LOn\r")
    wait(laser, on=True)
    child = fork(_until_terminated)
    time.sleep(0.2)
    child.terminate()
    child.join()
    time.sleep(0.2)
    assert laser.on
    require_supervisor()


def _until_terminated() -> None:
    signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
    time.sleep(10.0)


def test_ctrl_c_while_the_supervisor_starts_leaves_no_port_lent(
    laser: Laser, ports: Opening, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A notebook goes on: the port is not lent, and can be opened again."""

    class Interrupted(socket.socket):
        def recv(self, size: int) -> bytes:  # type: ignore[override]
            raise KeyboardInterrupt

    lend = Lifeline.lend
    with monkeypatch.context() as pressing:
        pressing.setattr(Lifeline, "lend", lambda own, request: Interrupted(fileno=lend(own, request).detach()))
        with pytest.raises(KeyboardInterrupt):
            ports(laser)
    assert not LIFELINE.lent
    assert ports(laser).is_open
