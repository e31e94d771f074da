"""The guard: a process that owns a laser's port, and switches the laser off when the program that uses it ends.

A laser that was told to emit goes on when its port closes. So the program never holds the port: this process does,
hands bytes to and fro, and switches off when the other end of its socket closes, whatever the cause: a normal end, an
exception, a SIGKILL; and when the program is stopped (Ctrl-Z). It is started by opening `guard://PORT`
(`hw.safety.ports.protocol_guard`), and the first that it writes to the port switches the laser off, so that one that
was left on goes out before any other command.

It does not help where no software does: a stopped computer, a broken cable while the laser is on (it switches off when
the port returns within ten minutes). If it is itself killed, the program has to notice, see docs/lab.md.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import select
import signal
import socket
import sys
import termios
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import serial

from hw.safety.signals import ENDING

log = logging.getLogger("guard")

OFF = b"\r?LOf\r"  # Omicron: emission off; the CR ends whatever the program had begun to say
STAY_OFF = b"?TPP0.00000\r?SAS0\r"  # no power and no autostart
ASK = b"?GAS\r"
TO_EMIT = b"LOn"
ON_OR_PREHEATING = 1 << 1 | 1 << 2  # of GAS; a laser that preheats emits some seconds later
TICK_S = 0.02  # how often the parent is looked after
ANSWER_S = 0.06  # emulated and real lasers answer within 30 ms
PATIENCE_S = 5.0  # with what does not confirm: then the user is warned
RETURN_S = 600.0  # how long a laser that was told to emit, or a port that vanished, is not given up
RETRY_S = 0.2
READY = b"\x06"
FAILURES = (OSError, termios.error)  # of a port; pyserial lets the second through where it empties its buffers
IS_OFF, UNCONFIRMED, OFF_AS_STOPPED = 0, 1, 3  # exit statuses; 2 is Python's own


def stopped(pid: int) -> bool:
    """Whether a process is stopped: Ctrl-Z, SIGSTOP or a debugger. Always False where there is no /proc."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace")
    except OSError:
        return False
    return fields.rpartition(")")[2].split()[0] in "Tt"  # the name, in brackets, may hold anything


@dataclass
class Program:
    """The program that uses the laser. Into `signals` the numbers of its signals are written, as they arrive.

    `guard_told`: the guard itself was told to end. `was_stopped`: that is why the laser went out.
    """

    pid: int
    signals: socket.socket
    guard_told: bool = False
    was_stopped: bool = False

    def ending(self) -> str | None:
        """Why the laser must go out, if it must."""
        if os.getppid() != self.pid:
            return "its program was killed"
        if self.guard_told:
            return "its guard was told to end"
        if stopped(self.pid):
            self.was_stopped = True
            return "its program was stopped"
        try:  # the bytes stay where they are: the guards of all lasers look at the same ones
            seen = self.signals.recv(4096, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except BlockingIOError:
            return None
        return "its program was told to end" if ENDING.intersection(seen) else None


class GuardClosed(serial.SerialException):
    """The program's end of a guarded port is closed: the guard is switching the laser off, or lost its port."""


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


@dataclass
class Relay:
    """Hands bytes to and fro. `told_to_emit`: the program has sent that command."""

    port: serial.Serial
    host: socket.socket
    told_to_emit: bool = False
    _said: bytes = b""  # the last bytes, since a command may arrive in pieces
    _heard: bytes = field(default=b"", init=False)  # what the program has not taken yet

    def run(self, program: Program) -> str:
        """Until the program ends; why it ended. A failure of the port is raised.

        Nothing here waits for the program: one that does not read, or a child of it that holds its socket, must not
        keep the guard from looking after it.
        """
        while True:
            source = [] if self._heard else [self.port.fileno()]
            sink = [self.host.fileno()] if self._heard else []
            readable, writable, _ = select.select([self.host.fileno(), *source], sink, [], TICK_S)
            ending = program.ending()
            if ending:
                return ending
            if self.host.fileno() in readable:
                data = self.host.recv(4096)
                if not data:
                    return "its port was closed"
                self._said = self._said[1 - len(TO_EMIT) :] + data
                self.told_to_emit |= TO_EMIT in self._said
                self.port.write(data)
            if self.port.fileno() in readable:
                self._heard = self.port.read(max(1, self.port.in_waiting))
            if self._heard and (writable or source):
                with contextlib.suppress(BlockingIOError):
                    self._heard = self._heard[self.host.send(self._heard, socket.MSG_DONTWAIT) :]


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


def _off(port: serial.Serial) -> bool:
    """Send the commands for off once. True if the laser confirms, and then that it neither emits nor is about to."""
    done = _answers(port, OFF, re.compile(rb"!LOf(.)")) == b">"
    _answers(port, STAY_OFF, re.compile(rb"!SAS(.)"))
    status = _answers(port, ASK, re.compile(rb"!GAS([0-9A-Fa-f]{1,4})\r"))
    return done and status is not None and not int(status, 16) & ON_OR_PREHEATING


def switch_off(url: str, baud: int, port: serial.Serial | None, patience_s: float, complained: bool = False) -> bool:
    """Repeat the commands for off until the laser confirms them, by a port that is opened anew whenever it fails.

    complained: the user has read already that the laser may be on
    """
    begun = time.monotonic()
    while time.monotonic() < begun + patience_s:
        try:
            if port is None:
                port = open_port(url, baud)
            if _off(port):
                port.close()
                return True
        except FAILURES as error:
            log.info("%s: %s; trying again", url, error)
            if port is not None:
                with contextlib.suppress(*FAILURES):  # it is gone
                    port.close()
            port = None
            time.sleep(RETRY_S)
        if time.monotonic() > begun + PATIENCE_S and not complained:
            complained = True
            _complain(url)
    if not complained:
        _complain(url)
    return False


def _complain(url: str) -> None:
    log.error("%s: THE LASER DOES NOT CONFIRM THAT IT IS OFF. Open the interlock or turn its key", url)


def _tell(host: socket.socket, error: Exception) -> None:
    with contextlib.suppress(OSError):  # nobody listens any more
        host.sendall(str(error).encode()[:200])


def guard(url: str, baud: int, host: socket.socket, program: Program) -> bool:
    """Own the port until the program ends; True if the laser was switched off for certain."""
    try:
        port = open_port(url, baud)
    except (*FAILURES, ValueError) as error:
        _tell(host, error)
        return True
    relay, patience_s, ready, complained = Relay(port, host), PATIENCE_S, False, False
    try:
        _answers(port, OFF, re.compile(rb"!(LOf[^\r]*)\r"))  # all of it: the program asked for none of this
        host.sendall(READY)
        ready = True
        log.info("%s: switching off: %s", url, relay.run(program))
    except (BrokenPipeError, ConnectionResetError):
        log.info("%s: switching off: its port was closed", url)
    except FAILURES as error:
        log.info("%s: the port is gone: %s", url, error)
        patience_s = RETURN_S
        if relay.told_to_emit:
            complained = True
            log.error(
                "%s: THE PORT IS GONE, AND THE LASER MAY BE ON. Open the interlock or turn its key; it will be "
                "switched off when the port returns", url
            )  # fmt: skip
        if not ready:
            _tell(host, error)
    finally:
        host.close()  # the program sees its port vanish
        if relay.told_to_emit:
            patience_s = RETURN_S
        off = switch_off(url, baud, port, patience_s, complained)
    return off


def main() -> int:
    """`python -m hw.safety.guard URL BAUD SOCKET SIGNALS PARENT`; started by `hw.safety.ports.protocol_guard` alone."""
    url, baud, descriptor, signals, parent = sys.argv[1], *map(int, sys.argv[2:6])
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s")
    with socket.socket(fileno=descriptor) as host, socket.socket(fileno=signals) as told:
        program = Program(parent, told)

        def told_to_end(number: int, frame: FrameType | None) -> None:
            program.guard_told = True  # and nothing is interrupted by it

        for number in ENDING:  # in a session of its own, it gets none that is for the program
            signal.signal(number, told_to_end)
        if not guard(url, baud, host, program):
            return UNCONFIRMED
        return OFF_AS_STOPPED if program.was_stopped else IS_OFF


if __name__ == "__main__":
    sys.exit(main())
