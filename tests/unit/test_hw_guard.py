"""The guard: the laser is off after every way in which a program can end, and before anything is said.

The laser here is a few lines behind a pty; `python -m benchmarks laser-safety` uses the emulated firmware.
"""

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
from contextlib import ExitStack, suppress
from pathlib import Path

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


def said_by(port: Serial) -> bytes:
    """Its next answer, without the CR."""
    got, end = b"", time.monotonic() + 2.0
    while not (plain := re.sub(rb"\$[^\r]*\r|\0", b"", got)).endswith(b"\r"):
        assert time.monotonic() < end, got
        got += port.read(64)
    return plain[:-1]


PROGRAM = """
import signal, sys, threading, time
from hw.guard import GuardClosed
from hw.ports.protocol_guard import Serial
port = Serial("guard://" + sys.argv[1], baudrate=500000, timeout=0.5, write_timeout=1)
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

    def start(laser: Laser, how: str, text: str = PROGRAM) -> subprocess.Popen[str]:
        program = subprocess.Popen(
            [sys.executable, "-c", text, laser.port, how], start_new_session=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        started.append(program)
        assert program.stdout is not None and program.stdout.readline() == "on\n"
        wait(laser, on=True)
        return program

    yield start
    for program in started:
        with program:  # closes its pipes
            program.kill()


@pytest.fixture
def lasers() -> Iterator[Callable[..., Laser]]:
    """Lasers that end with the test, whatever becomes of it, and their guards with them.

    A guard that its laser never answered goes on for ten minutes, and would meet the next test's terminal under the
    same name: it would lock it, and say LOf into it.
    """
    made: list[Laser] = []

    def make(on: bool = False, deaf: int = 0) -> Laser:
        made.append(Laser(on, deaf))
        return made[-1]

    yield make
    for laser in made:
        for guard_of_it in guards_of(port=laser.port):
            with suppress(ProcessLookupError):
                os.kill(guard_of_it, signal.SIGKILL)
        laser.close()


@pytest.fixture
def ports() -> Iterator[Callable[[Laser], Serial]]:
    """Opens guarded ports, and closes those that a test that fails leaves open."""
    with ExitStack() as left:

        def open_port(laser: Laser) -> Serial:
            port = Serial("guard://" + laser.port, baudrate=500000, timeout=0.5, write_timeout=1)
            left.callback(port.close)
            return port

        yield open_port


@pytest.fixture
def link(laser: Laser) -> Iterator[Link]:
    """A guarded link to the laser."""
    made = Link("guard://" + laser.port, 500000, "laser 635 nm", WallClock())
    yield made
    made.close()


def test_opening_switches_off_before_anything_is_said_and_closing_does_again(
    lasers: Callable[..., Laser], ports: Callable[[Laser], Serial]
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


@pytest.mark.parametrize("how", ["SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "fork"])
def test_off_though_the_main_thread_is_busy_or_a_child_keeps_the_socket(laser: Laser, run: Run, how: str) -> None:
    program = run(laser, "fork" if how == "fork" else "deaf")
    begun = time.monotonic()
    program.send_signal(signal.SIGKILL if how == "fork" else signal.Signals[how])
    wait(laser, on=False)
    assert laser.went_off - begun < LIMIT_S
    program.kill()
    program.communicate()


@pytest.mark.parametrize("how", ["exception", "exit"])
def test_off_at_the_end_of_the_program(laser: Laser, run: Run, how: str) -> None:
    program = run(laser, how)
    program.communicate("\n")
    wait(laser, on=False, limit_s=3)


def test_it_insists_until_the_laser_confirms(lasers: Callable[..., Laser], ports: Callable[[Laser], Serial]) -> None:
    laser = lasers(deaf=9)
    port = ports(laser)
    port.write(b"?LOn\r")
    wait(laser, on=True)
    port.close()
    wait(laser, on=False)
    assert laser.deaf == 0


@pytest.mark.parametrize("what", ["preheats", "refusals"])
def test_a_laser_that_preheats_or_refuses_is_not_taken_for_off(
    laser: Laser, ports: Callable[[Laser], Serial], what: str
) -> None:
    port = ports(laser)
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


def guards_of(pid: int | None = None, port: str = "") -> list[int]:
    """The guards that a program has started, or all of a port."""
    found = subprocess.run(["ps", "-eo", "pid=,ppid=,args="], capture_output=True, text=True, check=True)
    lines = [line.split() for line in found.stdout.splitlines() if f"-m hw.guard {port}" in line]
    return [int(own) for own, parent, *words in lines if pid in (None, int(parent)) and port in ("", *words)]


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


def test_a_guard_that_is_told_to_end_switches_off_first(laser: Laser, link: Link) -> None:
    link.write(b"?LOn\r")
    wait(laser, on=True)
    os.kill(guards_of(os.getpid())[0], signal.SIGTERM)
    wait(laser, on=False)
    with pytest.raises(SwitchedOff, match="its guard has closed it"):
        link.require_guard()


def test_a_port_that_does_not_exist_is_an_error_of_opening() -> None:
    with pytest.raises(serial.SerialException, match="No such file"):
        Serial("guard:///dev/disco-no-such-port", baudrate=500000, timeout=0.5)


def test_a_dead_port_says_so(laser: Laser, ports: Callable[[Laser], Serial]) -> None:
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
    laser: Laser, run: Run, ports: Callable[[Laser], Serial]
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


def test_every_guard_sees_the_signal(lasers: Callable[..., Laser], run: Run) -> None:
    """Three lasers, three guards, one signal, and a main thread that never gets to it."""
    three = [lasers() for _ in range(3)]
    program = run(three[0], ",".join(laser.port for laser in three[1:]), THREE)
    for laser in three:
        wait(laser, on=True)
    program.send_signal(signal.SIGTERM)
    for laser in three:
        wait(laser, on=False, limit_s=2 * LIMIT_S)


THREE = """
import signal, sys
from hw.ports.protocol_guard import Serial
signal.signal(signal.SIGTERM, lambda *_: sys.exit())
names = [sys.argv[1], *sys.argv[2].split(",")]
ports = [Serial("guard://" + name, baudrate=500000, timeout=0.5, write_timeout=1) for name in names]
for port in ports:
    port.write(b"?LOn\\r")
print("on", flush=True)
sum(range(2 * 10**9))
"""


# ---- what happens when a laser does not obey, or cannot


def test_a_laser_that_was_told_to_emit_is_not_given_up_and_the_user_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, lasers: Callable[..., Laser]
) -> None:
    """It hears after longer than the guard's patience; the command to emit came in two pieces."""
    monkeypatch.setattr(guard, "PATIENCE_S", 0.3)
    laser = lasers()
    ours, theirs = socket.socketpair()
    signals, _writer = socket.socketpair()
    with ours, signals, _writer:
        done: list[bool] = []
        program = guard.Program(os.getppid(), signals)
        thread = threading.Thread(target=lambda: done.append(guard.guard(laser.port, 500000, theirs, program)))
        thread.start()
        assert ours.recv(1) == guard.READY
        for piece in (b"?LO", b"n\r"):
            ours.sendall(piece)
            time.sleep(0.1)
        wait(laser, on=True)
        laser.deaf = 10**9
        ours.close()
        time.sleep(1.5)
        assert thread.is_alive() and laser.on
        laser.deaf = 0
        wait(laser, on=False)
        thread.join(5.0)
    assert done == [True]
    assert caplog.text.count("DOES NOT CONFIRM THAT IT IS OFF") == 1
    assert [r.levelname for r in caplog.records if "CONFIRM" in r.message] == ["ERROR"]


def test_a_laser_that_never_was_told_to_emit_is_given_up_with_a_complaint(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, lasers: Callable[..., Laser]
) -> None:
    monkeypatch.setattr(guard, "PATIENCE_S", 0.3)
    laser = lasers(deaf=10**9)
    ours, theirs = socket.socketpair()
    signals, _writer = socket.socketpair()
    with ours, signals, _writer:
        ours.close()
        assert not guard.guard(laser.port, 500000, theirs, guard.Program(os.getppid(), signals))
    assert caplog.text.count("DOES NOT CONFIRM THAT IT IS OFF") == 1


def test_a_cable_that_comes_back_within_ten_minutes_brings_the_switching_off(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, lasers: Callable[..., Laser]
) -> None:
    """The port vanishes while the laser emits, and comes back under its name: longer away than the guard's patience."""
    monkeypatch.setattr(guard, "PATIENCE_S", 0.3)
    laser, second = lasers(), lasers(on=True)
    name = tmp_path / "laser"
    name.symlink_to(laser.port)
    ours, theirs = socket.socketpair()
    signals, _writer = socket.socketpair()
    with ours, signals, _writer:
        done: list[bool] = []
        program = guard.Program(os.getppid(), signals)
        thread = threading.Thread(target=lambda: done.append(guard.guard(str(name), 500000, theirs, program)))
        thread.start()
        assert ours.recv(1) == guard.READY
        name.unlink()
        laser.close()  # unplugged
        assert ours.recv(1) == b""  # the program sees its port vanish at once
        time.sleep(1.0)
        assert thread.is_alive()
        name.symlink_to(second.port)
        wait(second, on=False)
        thread.join(5.0)
    assert done == [True]


def test_a_port_that_its_last_guard_still_holds_is_waited_for(laser: Laser, ports: Callable[[Laser], Serial]) -> None:
    held = serial.Serial(laser.port, exclusive=True)
    threading.Timer(0.5, held.close).start()
    assert ports(laser).is_open
    with pytest.raises(serial.SerialException, match="exclusively"):
        serial.Serial(laser.port, exclusive=True)  # and nobody else has it meanwhile


def test_what_the_laser_says_reaches_a_program_that_reads_slowly(
    laser: Laser, ports: Callable[[Laser], Serial]
) -> None:
    """More than a socket holds: the guard keeps what the program has not taken, and goes on looking after it."""
    port = ports(laser)
    flood = threading.Thread(target=lambda: [os.write(laser.master, b"%07d\n" % k) for k in range(60_000)])
    flood.start()
    time.sleep(0.5)
    got = b""
    while len(got) < 8 * 60_000:
        piece = port.read(4096)
        assert piece, f"silent after {len(got)} bytes"
        got += piece
    flood.join()
    assert got == b"".join(b"%07d\n" % k for k in range(60_000))


@pytest.mark.parametrize(
    ("line", "is_stopped"),
    [("7 (python) T 1", True), ("7 (python) t 1", True), ("7 (a) b T) S 1", False), ("7 (python) R 1", False)],
)
def test_the_state_of_a_process_is_read_whatever_it_is_called(
    monkeypatch: pytest.MonkeyPatch, line: str, is_stopped: bool
) -> None:
    """Stopped by a signal (T), by a debugger (t); a name may hold brackets and blanks (proc_pid_stat(5))."""
    monkeypatch.setattr(Path, "read_text", lambda self, errors: line)
    assert guard.stopped(7) is is_stopped


def test_signals_of_before_concern_no_laser_that_is_opened_now(laser: Laser, ports: Callable[[Laser], Serial]) -> None:
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
    assert laser.on and port.gone() is None


def test_forgetting_what_has_arrived_and_a_program_that_ends_an_open_port(
    laser: Laser, ports: Callable[[Laser], Serial]
) -> None:
    port = ports(laser)
    port.write(b"?GAS\r")
    end = time.monotonic() + 2.0
    while port.in_waiting < 8:
        assert time.monotonic() < end
        time.sleep(0.01)
    port.reset_input_buffer()
    assert port.in_waiting == 0
    port.close()
    assert port.gone() == "it is closed" and guards_of(port=laser.port) == []  # the guard has ended when this returns


def test_a_command_that_was_cut_short_does_not_spoil_the_switching_off(
    laser: Laser, ports: Callable[[Laser], Serial]
) -> None:
    port = ports(laser)
    port.write(b"?LOn\r")
    wait(laser, on=True)
    laser.said.clear()
    port.write(b"?MD")  # a program that dies in mid-sentence
    port.close()
    assert laser.said[0] == "LOf" and not laser.on


def test_a_program_is_told_that_its_laser_has_not_confirmed(lasers: Callable[..., Laser]) -> None:
    laser = lasers()
    link = Link("guard://" + laser.port, 500000, "laser 635 nm", WallClock())
    laser.deaf = 10**9
    (own,) = guards_of(port=laser.port)
    os.kill(own, signal.SIGTERM)
    os.waitid(os.P_PID, own, os.WEXITED | os.WNOWAIT)  # its patience is five seconds
    with pytest.raises(SwitchedOff, match=r"laser 635 nm is closed: .*HAS NOT CONFIRMED THAT IT IS OFF.*Remedy"):
        link.require_guard()
    link.close()
