"""The guard: a process that owns a laser's port, and switches the laser off when the program that uses it ends.

A laser that was told to emit goes on when its port closes. So the program never holds the port: this process does,
hands bytes to and fro, and switches off when the other end of its socket closes, whatever the cause: a normal end, an
exception, a SIGKILL. It is started by opening `guard://PORT` (`hw.ports.protocol_guard`), and the first that it writes
to the port switches the laser off, so that one that was left on goes out before anything else is said.

It does not help where no software does: a stopped computer, a broken cable while the laser is on (it switches off when
the port returns within ten minutes), its own death by SIGKILL. Those are the hardware interlock's, see docs/lab.md.
"""

from __future__ import annotations

import logging
import os
import re
import select
import signal
import socket
import sys
import time
from dataclasses import dataclass
from types import FrameType

import serial

log = logging.getLogger("guard")

OFF = b"\r?LOf\r"  # Omicron: emission off; the CR ends whatever the program had begun to say
STAY_OFF = b"?TPP0.00000\r?SAS0\r"  # no power and no autostart
ASK = b"?GAS\r"
ON_BIT = 1 << 1
TICK_S = 0.02  # how often the parent is looked after
ANSWER_S = 0.06  # emulated and real lasers answer within 30 ms
RETURN_S = 600.0  # how long a port that vanished is waited for
READY = b"\x06"
ENDING = frozenset({signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT})


@dataclass(frozen=True)
class Program:
    """The program that uses the laser. Into `signals` the numbers of its signals are written, as they arrive."""

    pid: int
    signals: socket.socket

    def ending(self) -> str | None:
        """Why the laser must go out, if it must."""
        if os.getppid() != self.pid:
            return "its program was killed"
        try:  # the bytes stay where they are: the guards of all lasers look at the same ones
            seen = self.signals.recv(4096, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except BlockingIOError:
            return None
        return "its program was told to end" if ENDING.intersection(seen) else None


class GuardClosed(serial.SerialException):
    """The program's end of a guarded port is closed: the guard is switching the laser off, or lost its port."""


class _Stop(Exception):
    """The guard itself is told to end."""


def open_port(url: str, baud: int) -> serial.Serial:
    """The laser's port; a guard that is just ending may hold it a moment longer."""
    end = time.monotonic() + 2.0
    while True:
        try:
            return serial.serial_for_url(url, baudrate=baud, timeout=TICK_S, write_timeout=0.5, exclusive=True)
        except serial.SerialException as error:
            if "exclusively" not in str(error) or time.monotonic() > end:
                raise
            time.sleep(TICK_S)


def relay(port: serial.Serial, host: socket.socket, program: Program) -> str:
    """Hand bytes to and fro until the program ends; why it ended. OSError: the port is gone."""
    while True:
        ready, _, _ = select.select([host.fileno(), port.fileno()], [], [], TICK_S)
        ending = program.ending()
        if ending:
            return ending
        if host.fileno() in ready:
            data = host.recv(4096)
            if not data:
                return "its port was closed"
            port.write(data)
        if port.fileno() in ready:
            data = port.read(max(1, port.in_waiting))
            if not data:
                raise serial.SerialException("the port delivers nothing though it is ready: unplugged")
            host.sendall(data)


def _answers(port: serial.Serial, command: bytes, wanted: re.Pattern[bytes]) -> bytes | None:
    """The first group of the answer, messages that begin with `$` taken out; None if it does not come in time."""
    port.write(command)
    got, end = b"", time.monotonic() + ANSWER_S
    while time.monotonic() < end:
        got += port.read(max(1, port.in_waiting))
        found = wanted.search(re.sub(rb"\$[^\r]*\r", b"", got).replace(b"\0", b""))
        if found:
            return found.group(1)
    return None


def switch_off(port: serial.Serial, patience_s: float = 5.0) -> bool:
    """Say off, and go on saying it until the laser confirms that it does not emit."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it is ending already
    end = time.monotonic() + patience_s
    port.write(OFF)
    port.write(STAY_OFF)
    while time.monotonic() < end:
        _answers(port, b"", re.compile(rb"!SAS(.)"))
        status = _answers(port, ASK, re.compile(rb"!GAS([0-9A-Fa-f]{1,4})\r"))
        if status is not None and not int(status, 16) & ON_BIT:
            return True
        port.write(OFF)
    return False


def _off_when_it_returns(url: str, baud: int) -> bool:
    """The port vanished: keep trying to reach the laser, which may still be on."""
    end = time.monotonic() + RETURN_S
    while time.monotonic() < end:
        try:
            with open_port(url, baud) as port:
                return switch_off(port)
        except OSError:
            time.sleep(0.2)
    return False


def guard(url: str, baud: int, host: socket.socket, program: Program) -> bool:
    """Own the port until the program ends; True if the laser was switched off for certain."""
    try:
        port = open_port(url, baud)
        _answers(port, OFF, re.compile(rb"!(LOf)"))
        port.reset_input_buffer()  # the program asked for none of this
    except (OSError, ValueError) as error:
        host.sendall(str(error).encode()[:200])
        return True
    try:
        host.sendall(READY)
        reason = relay(port, host, program)
        log.info("%s: switching off: %s", url, reason)
        return switch_off(port)
    except _Stop:
        return switch_off(port)
    except (BrokenPipeError, ConnectionResetError):
        return switch_off(port)
    except OSError as error:
        host.close()  # the program sees its port vanish
        log.warning("%s: the port is gone (%s); the laser will be switched off when it returns", url, error)
        port.close()
        return _off_when_it_returns(url, baud)


def _told_to_end(number: int, frame: FrameType | None) -> None:
    raise _Stop


def main() -> int:
    """`python -m hw.guard URL BAUD SOCKET SIGNALS PARENT`; started by `hw.ports.protocol_guard` alone."""
    url, baud, descriptor, signals, parent = sys.argv[1], *map(int, sys.argv[2:6])
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s")
    signal.signal(signal.SIGTERM, _told_to_end)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the program, whose end is seen here
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with socket.socket(fileno=descriptor) as host, socket.socket(fileno=signals) as told:
        if guard(url, baud, host, Program(parent, told)):
            return 0
    log.error("%s: THE LASER DOES NOT CONFIRM THAT IT IS OFF. Open the interlock or turn its key", url)
    return 1


if __name__ == "__main__":
    sys.exit(main())
