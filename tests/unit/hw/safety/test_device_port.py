"""Ports that are slow to open, gone for good, or another process's; devices that answer late; terminals that stop."""

from __future__ import annotations

import _socket
import errno
import fcntl
import logging
import os
import pty
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import serial
from capture_fakes import fork
from supervisor_fakes import LIMIT_S, Laser, Opening, serving, wait

from hw.safety import device_port, supervised_device, supervisor
from hw.safety.device_port import RETURN_S, SERVED_S, opened, return_s
from hw.safety.ports.protocol_supervised import LIFELINE, SupervisedPort, _in_numbers, require_supervisor


@pytest.fixture
def nobody() -> Iterator[str]:
    """A network port whose host takes no more connections: opening it neither succeeds nor fails."""
    with ExitStack() as left:
        server = left.enter_context(socket.create_server(("127.0.0.1", 0), backlog=0))
        for _ in range(4):
            waiting = left.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(server.getsockname())
        yield f"socket://127.0.0.1:{server.getsockname()[1]}"


def test_a_network_port_that_answers_nothing_is_an_error_in_time_and_nothing_waits_for_it(
    nobody: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_port, "CONNECT_S", 0.3)
    opening, begun = opened(nobody, 500000), time.monotonic()
    next(opening)
    assert time.monotonic() - begun < 0.2
    with pytest.raises(OSError, match=os.strerror(errno.ETIMEDOUT)):
        deque((time.sleep(0.01) for _ in opening), 0)
    assert time.monotonic() - begun >= 0.3


@pytest.mark.timing
def test_lasers_go_off_while_a_network_port_is_being_opened(
    laser: Laser, nobody: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervised_device, "PATIENCE_S", 0.3)
    with serving(laser.port) as (ours, host, _):
        host.sendall(b"?LOn\r")
        wait(laser, on=True)
        asked, lent = socket.socketpair()
        with asked, lent:
            asked.send(f"laser 500000 0 {nobody}".encode())
            socket.send_fds(ours, [supervisor.LEND], [lent.fileno()])
            time.sleep(0.1)
            begun = time.monotonic()
            ours.close()
            wait(laser, on=False)
            assert laser.went_off - begun < LIMIT_S


def test_names_of_hosts_are_looked_up_by_the_program() -> None:
    assert {*_in_numbers("socket://localhost:4001")} <= {"socket://127.0.0.1:4001", "socket://[::1]:4001"}
    assert _in_numbers("socket://10.0.0.5:4001") == ["socket://10.0.0.5:4001"]
    assert _in_numbers("/dev/ttyUSB0") == ["/dev/ttyUSB0"]
    with pytest.raises(ValueError, match="named"):
        next(opened("socket://named:1", 9600))


@contextmanager
def serial_server(laser: Laser, number: int = 0) -> Iterator[int]:
    """A program that serves a laser's port on 127.0.0.1 alone, as a serial server or an ssh tunnel does."""
    ended = threading.Event()
    with socket.create_server(("127.0.0.1", number)) as server:
        thread = threading.Thread(target=_serve, args=(server, laser.port, ended))
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            ended.set()
            thread.join()


def _serve(server: socket.socket, port: str, ended: threading.Event) -> None:
    cable = os.open(port, os.O_RDWR | os.O_NOCTTY)
    with ExitStack() as left:
        left.callback(os.close, cable)
        to: dict[int, int] = {}
        while not ended.is_set():
            for file in select.select([server.fileno(), *to], [], [], 0.01)[0]:
                if file == server.fileno():
                    user = left.enter_context(server.accept()[0]).fileno()
                    to = {user: cable, cable: user}
                elif data := os.read(file, 256):
                    os.write(to[file], data)
                else:
                    to = {}  # the user has hung up


def test_every_address_of_a_host_is_tried(laser: Laser, monkeypatch: pytest.MonkeyPatch) -> None:
    """`localhost` is ::1 first on many machines, and a server may be on 127.0.0.1 alone."""
    with serial_server(laser) as number:
        found = [(socket.SOCK_STREAM, 6, "", (address, number)) for address in ("::1", "::1", "127.0.0.1")]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: [(socket.AF_UNSPEC, *entry) for entry in found])
        url = f"socket://localhost:{number}"
        assert _in_numbers(url) == [f"socket://[::1]:{number}", f"socket://127.0.0.1:{number}"]
        port = SupervisedPort(f"supervised://laser:{url}", baudrate=500000, timeout=0.5, write_timeout=1)
        assert LIFELINE.lent[port].endswith(f" socket://127.0.0.1:{number}")  # what is repeated to the next supervisor
        port.write(b"?LOn\r")
        wait(laser, on=True)
        port.close()
        assert not laser.on
    with pytest.raises(serial.SerialException, match=os.strerror(errno.ECONNREFUSED)):
        port.open()


def test_a_connection_to_itself_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nobody listens the kernel may choose the very number as ours: held, no server could take it again."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        number = server.getsockname()[1]

    def unlucky(port: socket.socket, address: tuple[str, int]) -> int:
        port.bind(address)
        return _socket.socket.connect_ex(port, address)

    monkeypatch.setattr(socket.socket, "connect_ex", unlucky)
    with pytest.raises(ConnectionRefusedError):
        deque(opened(f"socket://127.0.0.1:{number}", 500000), 0)
    socket.create_server(("127.0.0.1", number)).close()


def test_a_lit_laser_behind_a_local_server_is_put_out_when_that_returns(
    lasers: Callable[..., Laser], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It is no emulator that has ended: the laser goes on emitting."""
    monkeypatch.setattr(device_port, "SERVED_S", 0.2)
    laser = lasers()
    with ExitStack() as tunnel:
        number = tunnel.enter_context(serial_server(laser))
        with serving(f"socket://127.0.0.1:{number}") as (_, host, thread):
            host.sendall(b"?LOn\r")
            wait(laser, on=True)
            tunnel.close()
            time.sleep(0.8)
            assert thread.is_alive() and laser.on
            with serial_server(laser, number):
                wait(laser, on=False)
                thread.join(3.0)
                assert not thread.is_alive()
    assert "LIGHT MAY BE ON" in caplog.text and "if the port returns within 600 s" in caplog.text


def test_a_terminal_that_has_hung_up_is_given_up_at_once(
    lasers: Callable[..., Laser], caplog: pytest.LogCaptureFixture
) -> None:
    """Its number is given to the next terminal: by that, another device would be spoken to."""
    laser = lasers()
    with serving(laser.port) as (_, host, thread):
        host.sendall(b"?LOn\r")
        wait(laser, on=True)
        laser.close()
        thread.join(2.0)
        assert not thread.is_alive()
    assert "LIGHT MAY BE ON" in caplog.text and "the program that served it has ended" in caplog.text


def test_a_served_port_that_does_not_return_is_given_up_soon(
    lasers: Callable[..., Laser], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The emulator has ended, and has taken its links away."""
    monkeypatch.setattr(device_port, "SERVED_S", 0.5)
    laser, name = lasers(), tmp_path / "laser"
    name.symlink_to(laser.port)
    with serving(str(name)) as (_, host, thread):
        host.sendall(b"?LOn\r")
        wait(laser, on=True)
        begun = time.monotonic()
        name.unlink()
        laser.close()
        thread.join(3.0)
        assert not thread.is_alive() and time.monotonic() - begun >= 0.5
    assert "it is made dark if the port returns within 0.5 s" in caplog.text


def test_how_long_a_port_may_be_away(laser: Laser, tmp_path: Path) -> None:
    link = tmp_path / "laser"
    link.symlink_to(laser.port)
    assert return_s(laser.port) == 0.0
    assert return_s(str(link)) == SERVED_S
    assert return_s("/dev/ttyUSB0") == return_s("socket://10.0.0.5:7") == RETURN_S == 600.0
    assert return_s("socket://127.0.0.1:7") == return_s("socket://[::1]:7") == RETURN_S


def test_a_laser_whose_answers_come_late_is_believed(laser: Laser, caplog: pytest.LogCaptureFixture) -> None:
    """Each attempt waits for longer. Else every answer would come to the question after its own, for ever."""
    laser.late_s = 0.1
    with serving(laser.port) as (_, host, _):
        host.sendall(b"?LOn\r")
        wait(laser, on=True)
    assert not laser.on and "CONFIRM" not in caplog.text


@contextmanager
def standard_error(file: int) -> Iterator[None]:
    kept = os.dup(2)
    try:
        os.dup2(file, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def test_what_is_said_into_a_file_stands_behind_what_the_program_has_said(tmp_path: Path) -> None:
    with (tmp_path / "said").open("wb", 0) as file, standard_error(file.fileno()):
        terminal = supervisor.Terminal()
        for words in (b"first\n", b"third\n"):
            file.write(words)
            terminal.handle(logging.makeLogRecord({"msg": "the supervisor's"}))
    assert (tmp_path / "said").read_text() == "first\nthe supervisor's\nthird\nthe supervisor's\n"


@pytest.mark.parametrize("held", [0, 1 << 20])
def test_a_terminal_that_is_stopped_holds_nothing_up(held: int) -> None:
    """Nobody reads it: whether it is full before a message, or becomes so in the middle of one."""
    master, slave = pty.openpty()
    with standard_error(slave):
        terminal = supervisor.Terminal()
    text = "the laser does not confirm" + held * "."
    saying = threading.Thread(
        target=lambda: [terminal.handle(logging.makeLogRecord({"msg": text})) for _ in range(3 if held else 4_000)],
        daemon=True,
    )
    saying.start()
    saying.join(5.0)
    stuck = saying.is_alive()
    assert os.read(master, 26) == b"the laser does not confirm"
    assert not fcntl.fcntl(slave, fcntl.F_GETFL) & os.O_NONBLOCK  # the program's own waits as before
    for end in (master, slave):
        os.close(end)
    os.close(terminal._file)
    assert not stuck


def test_a_child_that_is_forked_has_no_port_and_closes_none(laser: Laser, ports: Opening) -> None:
    port = ports(laser)
    port.write(b"?LOn\r")
    wait(laser, on=True)
    held, left = threading.Event(), threading.Event()
    holder = threading.Thread(target=_hold, args=(held, left))
    holder.start()
    held.wait()
    child = fork(_child, port)
    left.set()
    holder.join()
    child.join(10.0)
    assert child.exitcode == 0
    time.sleep(0.2)
    assert laser.on
    require_supervisor()


def _child(port: SupervisedPort) -> None:
    assert not LIFELINE.lent and not port.is_open
    port.close()
    assert LIFELINE._lock.acquire(timeout=1.0)


def _hold(held: threading.Event, left: threading.Event) -> None:
    """As a beat does."""
    with LIFELINE._lock:
        held.set()
        left.wait()
