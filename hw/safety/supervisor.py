"""The supervisor: one process that owns the ports of board and lasers, and makes them dark when its program ends.

A laser that was told to emit goes on when its port closes, and a gate stays open. So the program holds none of these
ports: this process does, and lends them. The program holds a socket, its *lifeline*. There is one rule: on the first
sign that the program is not in control any more, every device is made dark. `Supervisor._ending` lists the signs. All
devices are told at once, then each again and again until it confirms; none of them is waited for by another.

The argument, to be checked line by line: docs/laser-safety.md. Started by `hw.safety.ports.protocol_supervised` alone.
"""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import select
import signal
import socket
import stat
import sys
import time
from contextlib import suppress
from pathlib import Path

from hw.safety.darkness import KINDS, Ready
from hw.safety.device_port import FAILURES
from hw.safety.signals import ENDING
from hw.safety.supervised_device import REMEDY, SupervisedDevice

log = logging.getLogger("supervisor")

BEAT, LEND = b"\x00", b"\xff"  # on the lifeline, beside the numbers of the program's signals: every message is one byte
TICK_S = 0.01  # how often the program is looked after
SILENCE_S = 3.0  # without a beat; beats come every 0.1 s, and a renderer in the program may hold them up for 1 s
REALTIME = 10  # a priority above all ordinary processes
PF_EXITING = 4  # of Linux
LOCK_ALL = 3  # MCL_CURRENT | MCL_FUTURE


def stopped(pid: int) -> bool:
    """Whether a process is stopped (Ctrl-Z, SIGSTOP, a debugger) or about to die. Always False where there is no /proc.

    One that got SIGKILL on a busy machine keeps its sockets until it has had a processor to give its memory back.
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace")
    except OSError:
        return False
    state, *numbers = fields.rpartition(")")[2].split()  # the name, in brackets, may hold anything
    exiting, pending = map(int, [*numbers[5:6], *numbers[27:28], "0", "0"][:2])  # proc_pid_stat(5)
    return state in "Tt" or bool(exiting & PF_EXITING) or bool(pending & 1 << signal.SIGKILL - 1)


class Supervisor:
    """Serves the program at the other end of a lifeline. `cause`: why everything is dark, once it is to be."""

    def __init__(self, lifeline: socket.socket, program: int) -> None:
        self._lifeline, self._program, self._beat_at = lifeline, program, time.monotonic()
        self._devices: list[SupervisedDevice] = []
        self.cause: str | None = None
        self.told_to_end = False

    def run(self) -> None:
        """Until the program is not in control any more, and every device has confirmed darkness or was given up."""
        while self.cause is None or self._devices:
            sources = [file for device in self._devices for file in device.sources()]
            ready = set(select.select([self._lifeline.fileno(), *sources][self.cause is not None :], [], [], TICK_S)[0])
            if self.cause is None and (cause := self._ending(ready)):
                self._make_all_dark(cause)
                self._take_what_waits()
            for device in tuple(self._devices):
                try:
                    confirmed = device.serve(ready)
                except FAILURES as error:
                    log.info("%s: %s", device.url, error)
                    self._make_all_dark(f"the port {device.url} is gone: its cable was pulled, or it lost power")
                    confirmed = None
                if confirmed is not None:
                    self._give_back(device, confirmed)

    def _ending(self, ready: Ready) -> str | None:
        """The first sign that the program is not in control any more."""
        if os.getppid() != self._program:
            return "the program was killed"
        if stopped(self._program):
            return "the program was stopped (Ctrl-Z or SIGSTOP), and everything made dark for that time"
        if self.told_to_end:
            return "the supervisor was told to end"
        if self._lifeline.fileno() in ready:
            data, files, _, _ = socket.recv_fds(self._lifeline, 4096, 16)
            for file in files:
                self._lend(socket.socket(fileno=file))
            if not data:
                return "the program has ended"
            if ENDING.intersection(data):
                return "the program was told to end"
            self._beat_at = time.monotonic()
        if time.monotonic() > self._beat_at + SILENCE_S and self._devices:
            return f"the program gave no sign of life for {SILENCE_S:g} s"
        return None

    def _lend(self, host: socket.socket) -> None:
        """Open the port that the first message on its socket names."""
        try:
            self._devices.append(SupervisedDevice(host))
        except (OSError, KeyError, ValueError) as error:
            log.info("%s", error)
            host.close()

    def _make_all_dark(self, cause: str) -> None:
        """Tell all devices before any of them is waited for, the board first. A second time it does nothing."""
        if self.cause is not None:
            return
        self.cause = cause
        for device in sorted(self._devices, key=lambda device: list(KINDS.values()).index(device.kind)):
            device.make_dark()
        self._tell(cause)
        for device in self._devices:
            with suppress(OSError):
                device.host.shutdown(socket.SHUT_RDWR)  # the program sees its port vanish

    def _take_what_waits(self) -> None:
        """Ports that were asked for before the end and not opened yet: a supervisor in place of one that was killed may
        find the program gone before it has read which devices are to be dark.
        """
        self._lifeline.setblocking(False)  # `recv_fds` leaves its flags out
        with suppress(OSError):
            while True:
                data, files, _, _ = socket.recv_fds(self._lifeline, 4096, 16)
                for file in files:
                    self._lend(socket.socket(fileno=file))
                if not data:
                    break
        for device in self._devices:
            device.make_dark()

    def _give_back(self, device: SupervisedDevice, confirmed: bool) -> None:
        if not confirmed and self.cause is not None:  # else the others go on, and the log has said it
            self._tell(f"; {device.url}: {device.kind.warning}. {REMEDY}")
        device.close()
        device.host.close()  # what the program waits for when it closes its port
        self._devices.remove(device)

    def _tell(self, text: str) -> None:
        log.info("%s", text)
        with suppress(OSError):  # nobody reads it any more
            self._lifeline.send(text.encode(), socket.MSG_DONTWAIT)


def come_first() -> list[str]:
    """Take precedence over all ordinary processes and stay in memory; what of that the system does not allow."""
    refused = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REALTIME))
    except (OSError, AttributeError):
        refused.append("raise its priority (`ulimit -r 10`)")
    if ctypes.CDLL(None).mlockall(LOCK_ALL):
        refused.append("lock its memory (`ulimit -l unlimited`)")
    return refused


class Terminal(logging.Handler):
    """Says to standard error what it takes at once: one that is stopped (Ctrl-S) holds nothing up.

    It is opened anew, since the program has the other description of it, and is to go on waiting for it. A file, which
    never holds anything up, is not: its words would be written over the program's.
    """

    def __init__(self) -> None:
        super().__init__()
        self._file = 2
        with suppress(OSError):  # no Linux, a socket, or closed
            if not stat.S_ISREG(os.fstat(2).st_mode):
                self._file = os.open("/proc/self/fd/2", os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)

    def emit(self, record: logging.LogRecord) -> None:
        """What it does not take is lost."""
        with suppress(OSError):
            if select.select([], [self._file], [], 0.0)[1]:
                os.write(self._file, f"{self.format(record)}\n".encode())


def main() -> None:
    """`python -m hw.safety.supervisor LIFELINE PROGRAM`: a socket's descriptor, and the program's process id."""
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s", handlers=[Terminal()])
    gc.disable()  # nothing here makes circles
    refused = come_first()
    if refused:
        log.warning("may not %s: on a busy machine light may stay on for longer", " nor ".join(refused))
    with socket.socket(fileno=int(sys.argv[1])) as lifeline:
        supervisor = Supervisor(lifeline, int(sys.argv[2]))
        for number in ENDING:  # in a session of its own, it gets none that is for the program
            signal.signal(number, lambda *_: setattr(supervisor, "told_to_end", True))
        supervisor.run()


if __name__ == "__main__":
    main()
