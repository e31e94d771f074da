"""Zaber turntables: the ASCII protocol, 115200 baud.

`/device axis id command:CC` is answered by `@device axis id OK IDLE -- data:CC`, where id is ours: an answer to
another command is recognised by it, however late. CC is the two's complement of the sum of the bytes between the
first character and the colon. `!` alerts and `#` information come unasked.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass

import numpy as np

from hw.base.errors import DeviceError, DeviceFault, DeviceRefused, NoAnswer
from hw.devices.turning import BLOCKED, POLL_S, degrees_of, not_reached
from hw.serial.link import Inbox, LineFramer, Link, asked, persist

log = logging.getLogger(__name__)

BAUD = 115_200
ANSWER_S = 0.5
HOME_S = 60.0
KEYS = "ports and microsteps_per_deg"
FAULTS = {
    "FD": ("has switched its driver off", "let it cool down, then switch it off and on"),
    "FQ": ("was stopped by its encoder", BLOCKED),
    "FS": ("has stalled", BLOCKED),
    "FH": ("is held by its emergency stop", "release the emergency stop, then home it again"),
    "NI": ("was interrupted in a move", "keep hands off its knob and commands"),
}
LOST = {"WR", "WH"}  # no reference position, not homed
REPLY = re.compile(
    r"@(?P<device>\d\d) (?P<axis>\d) (?:(?P<id>\d\d) )?(?P<flag>OK|RJ) (?P<status>IDLE|BUSY) (?P<warning>[A-Z-]{2})"
    r" (?P<data>\S.*)"
)


def checksum(body: str) -> str:
    """Two's complement of the sum of the bytes, as two hex digits."""
    return f"{-sum(body.encode('latin-1')) & 0xFF:02X}"


@dataclass(frozen=True)
class Reply:
    """An answer. `checked`: it had a checksum, and the right one."""

    device: int
    id: int | None
    accepted: bool
    busy: bool
    warning: str
    data: str
    checked: bool


class ZaberFramer:
    """Answers (`@...`); alerts, information, garbage and what has a wrong checksum are dropped."""

    def __init__(self) -> None:
        self._lines = LineFramer()
        self.reset = self._lines.reset

    def feed(self, data: bytes) -> list[Reply]:
        """The answers that end in these bytes."""
        return [reply for line in self._lines.feed(data) if (reply := parse(line)) is not None]


def parse(line: str) -> Reply | None:
    """One line, or None if it is no sound answer. Whatever precedes the last `@` is dropped."""
    line = line[max(line.rfind("@"), 0) :]
    body, colon, check = line.rpartition(":")
    if colon and check != checksum(body[1:]):
        return None
    found = REPLY.fullmatch(body if colon else line)
    if found is None:
        return None
    number = found["id"]
    return Reply(
        int(found["device"]),
        None if number is None else int(number),
        found["flag"] == "OK",
        found["status"] == "BUSY",
        found["warning"],
        found["data"],
        bool(colon),
    )


class ZaberTable:
    """A rotary stage. `microsteps_per_deg` is checked against what the stage reports of itself."""

    def __init__(
        self, link: Link, microsteps_per_deg: float, reach_s: float = 20.0, device: int = 1, axis: int = 1
    ) -> None:
        self.link, self.microsteps_per_deg, self.reach_s = link, microsteps_per_deg, reach_s
        self._device, self._axis, self._id = device, axis, 0
        self._checked = False
        self._inbox: Inbox[Reply] = Inbox(link, ZaberFramer())
        self.serial_number = self._identify()

    # ---- talking

    def _once(self, command: str) -> Reply:
        self._id = (self._id + 1) % 100
        body = f"{self._device:02d} {self._axis} {self._id:02d}" + (f" {command}" if command else "")
        self._inbox.clear()
        self.link.write(f"/{body}:{checksum(body)}\r\n".encode("ascii"))
        reply = self._inbox.next(
            lambda r: (r.device, r.id) == (self._device, self._id) and r.checked >= self._checked, ANSWER_S
        )
        if reply is None:
            raise self.link.no_answer(repr(command or "a status request"), ANSWER_S)
        return reply

    def ask(self, command: str) -> Reply:
        """The answer to what may be asked twice: reading, and moving to a place."""
        return persist(lambda: self._once(command), self._inbox.clear)

    def _number(self, setting: str) -> float:
        def once() -> str:
            reply = self._once(f"get {setting}")
            if not reply.accepted:
                raise self._refused(f"get {setting}", reply)
            return reply.data

        return asked(self.link, f"'get {setting}'", once, lambda data: float(data.split()[0]), self._inbox.clear)

    def _refused(self, command: str, reply: Reply) -> DeviceRefused | DeviceFault:
        if reply.warning in FAULTS:
            return self.link.error(DeviceFault, *FAULTS[reply.warning])
        if reply.warning in LOST:
            problem = f"does not know where it stands ({reply.warning}) and refused {command!r}"
            return self.link.error(DeviceFault, problem, "its power was cut or it is new: home it")
        problem = f"refused {command!r} ({reply.data})"
        return self.link.error(DeviceRefused, problem, "check its settings with Zaber Launcher")

    # ---- identity

    def _identify(self) -> str:
        try:
            self.ask("")
        except NoAnswer as error:
            problem = f"is not a Zaber stage: asked for its status, {self.link.heard()}"
            raise self.link.wrong_device(problem, KEYS) from error
        self._checked = self.ask("set comm.checksum 1").accepted
        if not self._checked:
            log.warning("%s: its firmware sends no checksums; a garbled digit may go unnoticed", self.link.device)
        turn = self.ask("get limit.cycle.dist")
        expected = round(360.0 * self.microsteps_per_deg)
        found = turn.data.split()[0] if turn.accepted else "none (a linear stage?)"
        if found != str(expected):
            problem = f"has {found} microsteps a turn instead of {expected} (microsteps_per_deg)"
            raise self.link.wrong_device(problem, KEYS)
        return self.ask("get system.serial").data

    # ---- moving

    def home(self) -> None:
        """Find the reference position; the table then stands at 0."""
        self._start("home")
        self._wait(0.0, HOME_S)

    def move(self, angle_rad: float) -> None:
        """Turn to an angle; returns when the table stands still there. Raises: DeviceFault, NoAnswer."""
        angle = degrees_of(angle_rad)
        target = round(angle * self.microsteps_per_deg)
        self._start(f"move abs {target}")
        self._wait(angle, self.reach_s)
        found = self._number("pos")
        if abs(found - target) > 1:
            problem = f"stopped at {found / self.microsteps_per_deg:.3f} deg instead of {angle:.3f} deg"
            raise self.link.error(DeviceFault, problem, BLOCKED)

    def _start(self, command: str) -> None:
        reply = self.ask(command)
        if not reply.accepted:
            raise self._refused(command, reply)

    def _wait(self, angle_deg: float, limit_s: float) -> None:
        """Poll until the table is idle."""
        clock = self.link.clock
        end = clock.now() + limit_s
        while (reply := self.ask("")).busy:
            if clock.now() > end:
                self.stop()
                where = f"it stands at {np.rad2deg(self.angle_rad()):.1f} deg"
                raise not_reached(self.link, angle_deg, limit_s, where)
            clock.sleep(POLL_S)
        if reply.warning in FAULTS.keys() | LOST:
            self.ask("warnings clear")
            raise self._refused(f"go to {angle_deg:.1f} deg", reply)

    def angle_rad(self) -> float:
        """Where it stands, 0 .. 2 pi."""
        return float(np.deg2rad(self._number("pos") / self.microsteps_per_deg % 360.0))

    def stop(self) -> None:
        """Stop at once; that a move was interrupted by this is no fault to be reported later."""
        self.ask("stop")
        self.ask("warnings clear")

    def close(self) -> None:
        """Stop, should a move have been interrupted, as far as the table still listens, and give the port back."""
        try:
            self.stop()
        except DeviceError as error:
            log.info("closing the turntable: %s", error)
        finally:
            self.link.close()
