"""The supervisor where a device does not obey, its cable is gone, or the program does not listen."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
import serial
from supervisor_fakes import LIMIT_S, Laser, Opening, said_by, serving, wait

from hw.base.clock import WallClock
from hw.base.errors import SwitchedOff
from hw.safety import supervised_device, supervisor
from hw.safety.ports.protocol_supervised import LIFELINE, require_supervisor
from hw.serial.link import Link


def test_a_laser_that_was_told_to_emit_is_not_given_up_and_the_user_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, lasers: Callable[..., Laser]
) -> None:
    """It hears after longer than the supervisor's patience; the command to emit came in two pieces."""
    monkeypatch.setattr(supervised_device, "PATIENCE_S", 0.3)
    laser = lasers()
    with serving(laser.port) as (ours, host, thread):
        for piece in (b"?LO", b"n\r"):
            host.sendall(piece)
            time.sleep(0.1)
        wait(laser, on=True)
        laser.deaf = 10**9
        ours.close()
        time.sleep(1.5)
        assert thread.is_alive() and laser.on
        laser.deaf = 0
        wait(laser, on=False)
    assert caplog.text.count("DOES NOT CONFIRM THAT IT IS OFF") == 1
    assert [r.levelname for r in caplog.records if "CONFIRM" in r.message] == ["ERROR"]


def test_a_laser_that_never_was_told_to_emit_is_given_up_with_a_complaint(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, lasers: Callable[..., Laser]
) -> None:
    monkeypatch.setattr(supervised_device, "PATIENCE_S", 0.3)
    with serving(lasers(deaf=10**9).port):
        pass
    assert caplog.text.count("DOES NOT CONFIRM THAT IT IS OFF") == 1


def test_a_cable_that_comes_back_within_ten_minutes_brings_the_switching_off(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, lasers: Callable[..., Laser]
) -> None:
    """The port vanishes while the laser emits, and comes back under its name: away for longer than any patience."""
    monkeypatch.setattr(supervised_device, "PATIENCE_S", 0.3)
    laser, second = lasers(), lasers(on=True)
    name = tmp_path / "laser"
    name.symlink_to(laser.port)
    with serving(str(name)) as (ours, host, thread):
        name.unlink()
        laser.close()  # unplugged
        while host.recv(64):  # the program sees its port vanish at once
            pass
        assert f"the port {name} is gone" in ours.recv(4096).decode()
        time.sleep(1.0)
        assert thread.is_alive()
        name.symlink_to(second.port)
        wait(second, on=False)


@pytest.mark.timing
def test_one_cable_that_is_pulled_makes_everything_dark(lasers: Callable[..., Laser], ports: Opening) -> None:
    """A board that is gone leaves its gate open: the lasers behind it go off without asking the program."""
    first, second = lasers(), lasers()
    for laser in (first, second):
        ports(laser).write(b"?LOn\r")
        wait(laser, on=True)
    begun = time.monotonic()
    first.close()
    wait(second, on=False)
    assert second.went_off - begun < LIMIT_S
    with pytest.raises(SwitchedOff, match="is gone: its cable was pulled"):
        require_supervisor()


@pytest.mark.timing
def test_closing_one_port_leaves_the_others_lent(lasers: Callable[..., Laser], ports: Opening) -> None:
    first, second = lasers(), lasers()
    closed, kept = ports(first), ports(second)
    kept.write(b"?LOn\r")
    wait(second, on=True)
    first.deaf = 10**9
    begun = time.monotonic()
    closed.close()  # it never confirms
    assert time.monotonic() - begun < 1.0 + LIMIT_S and second.on
    kept.write(b"?GAS\r")
    require_supervisor()


def test_a_port_that_its_last_supervisor_still_holds_is_waited_for(laser: Laser, ports: Opening) -> None:
    held = serial.Serial(laser.port, exclusive=True)
    until = threading.Timer(0.5, held.close)
    until.start()
    assert ports(laser).is_open
    until.join()
    with pytest.raises(serial.SerialException, match="exclusively"):
        serial.Serial(laser.port, exclusive=True)  # and nobody else has it meanwhile


def test_what_the_laser_says_reaches_a_program_that_reads_slowly(laser: Laser, ports: Opening) -> None:
    """More than a socket holds: the supervisor keeps what the program has not taken, and goes on looking after it."""
    port = ports(laser)
    said_by(port)  # to the LOf of opening it
    flood = threading.Thread(target=lambda: [os.write(laser.master, b"%07d\n" % k) for k in range(60_000)])
    flood.start()
    time.sleep(0.5)
    got, end = b"", time.monotonic() + 30.0
    while len(got) < 8 * 60_000:  # on a busy machine there may be silence: what has been lost never comes
        assert time.monotonic() < end, f"{len(got)} bytes came"
        got += port.read(4096)
    flood.join()
    assert got == b"".join(b"%07d\n" % k for k in range(60_000))


@pytest.mark.parametrize(
    ("line", "is_stopped"),
    [
        ("7 (python) T 1", True),
        ("7 (python) t 1", True),
        ("7 (a) b) T 1", True),
        ("7 (a T b) S 1", False),
        ("7 (python) R 1", False),
        ("7 (python) R 1 7 7 0 -1 4194560" + 21 * " 1" + " 0 0", False),
        ("7 (python) R 1 7 7 0 -1 4194564" + 21 * " 1" + " 0 0", True),  # it is exiting
        ("7 (python) R 1 7 7 0 -1 4194560" + 21 * " 1" + " 256 0", True),  # SIGKILL waits for it
    ],
)
def test_the_state_of_a_process_is_read_whatever_it_is_called(
    monkeypatch: pytest.MonkeyPatch, line: str, is_stopped: bool
) -> None:
    """Stopped by a signal (T), by a debugger (t); a name may hold brackets and blanks (proc_pid_stat(5))."""
    monkeypatch.setattr(Path, "read_text", lambda self, errors: line)
    assert supervisor.stopped(7) is is_stopped


def test_signals_of_before_concern_no_laser_that_is_opened_now(laser: Laser, ports: Opening) -> None:
    """A program that obeyed Ctrl-C and goes on may open its lasers again."""
    first = ports(laser)
    with suppress(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1.0)
    wait(laser, on=False)
    first.close()
    port = ports(laser)
    port.write(b"?LOn\r")
    wait(laser, on=True)
    time.sleep(0.2)
    assert laser.on
    require_supervisor()


def test_what_has_arrived_and_a_program_that_ends_an_open_port(laser: Laser, ports: Opening) -> None:
    port = ports(laser)
    said_by(port)
    port.write(b"?GAS\r")
    end = time.monotonic() + 2.0
    while port.in_waiting < 8:
        assert time.monotonic() < end
        time.sleep(0.01)
    assert port.read(port.in_waiting).startswith(b"\0!GA") and port.in_waiting == 0
    port.close()
    assert laser.said[-1] == "GAS"  # it has confirmed when this returns
    serial.Serial(laser.port, exclusive=True).close()  # and nobody has its port


def test_a_command_that_was_cut_short_does_not_spoil_the_switching_off(laser: Laser, ports: Opening) -> None:
    port = ports(laser)
    port.write(b"?LOn\r")
    wait(laser, on=True)
    laser.said.clear()
    port.write(b"?MD")  # a program that dies in mid-sentence
    port.close()
    assert laser.said[0] == "LOf" and not laser.on


def test_a_program_is_told_that_its_laser_has_not_confirmed(lasers: Callable[..., Laser]) -> None:
    laser = lasers()
    link = Link("supervised://laser:" + laser.port, 500000, "laser 635 nm", WallClock())
    while b">" not in link.read(0.5):  # it has answered the LOf of opening: else this would come to the next one
        pass
    laser.deaf = 10**9
    LIFELINE._supervisors[-1].terminate()
    LIFELINE._supervisors[-1].wait(10.0)  # its patience is five seconds
    with pytest.raises(SwitchedOff, match=r"the rig is dark: .*NOT CONFIRM THAT IT IS OFF.*Remedy"):
        require_supervisor()
    link.close()


@pytest.mark.timing
def test_closing_is_heard_though_a_child_has_a_copy_of_the_socket(laser: Laser, ports: Opening) -> None:
    port = ports(laser)
    port.write(b"?LOn\r")
    wait(laser, on=True)
    copy = os.dup(port._open_host().fileno())  # what a child that was forked would hold
    try:
        begun = time.monotonic()
        port.close()
        assert laser.went_off - begun < LIMIT_S and not laser.on
    finally:
        os.close(copy)


def test_closing_a_port_whose_supervisor_was_killed_switches_off(laser: Laser, ports: Opening) -> None:
    """Though nobody had asked after it before."""
    port = ports(laser)
    port.write(b"?LOn\r")
    wait(laser, on=True)
    own = LIFELINE._supervisors[-1].pid
    laser.said.clear()
    os.kill(own, signal.SIGKILL)
    os.waitid(os.P_PID, own, os.WEXITED | os.WNOWAIT)
    port.close()
    assert not laser.on and laser.said[0] == "LOf"


def test_a_link_that_went_dark_says_that_and_not_that_a_cable_is_out(link: Link) -> None:
    """The rig takes the first for granted when it is made safe, and reports the second."""
    LIFELINE._supervisors[-1].terminate()
    LIFELINE._supervisors[-1].wait(5.0)
    with pytest.raises(SwitchedOff, match="the port of laser 635 nm"):
        link.write(b"?GAS\r")
    link.read(0.0)
    with pytest.raises(SwitchedOff, match="the port of laser 635 nm"):
        link.read(0.5)
