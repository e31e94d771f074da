"""The firmware of a Zaber rotary stage: the ASCII protocol in front of a `Spindle`."""

from __future__ import annotations

import re

from disco_twin.firmware.turning import Spindle
from disco_twin.firmware.wire import LineFirmware, Timed
from hw.devices.zaber import BAUD, checksum

LATENCY_S = 0.002
COMMAND = re.compile(r"/(?:(\d{1,2})(?: (\d)(?: (\d{1,2}|--))?)?)? ?(.*)")
MICROSTEPS_PER_DEG = 768_000 / 360.0  # of an X-RSW60A
MAX_POSITION = 768_000_000


class ZaberFirmware(LineFirmware):
    """One stage with one axis. Messages with a wrong checksum, or for another device, are ignored."""

    baud = BAUD

    def __init__(
        self, spindle: Spindle, microsteps_per_deg: float = MICROSTEPS_PER_DEG, address: int = 1, stage: str = "rotary"
    ) -> None:
        super().__init__(b"\r\n")
        self.spindle, self.microsteps_per_deg, self.address = spindle, microsteps_per_deg, address
        self.driver_on, self.emergency_stop, self.interrupted = True, False, False
        turn = round(360.0 * microsteps_per_deg) if stage == "rotary" else 0
        self.settings = {
            "deviceid": "50997",
            "device.id": "50997",
            "version": "7.35",
            "version.build": "1234",
            "system.serial": "73402",
            "system.axiscount": "1",
            "system.access": "1",
            "comm.checksum": "0",
            "comm.alert": "0",
            "comm.address": str(address),
            "limit.cycle.dist": str(turn),
            "limit.min": "0",
            "limit.max": str(MAX_POSITION),
            "resolution": "64",
            "peripheral.id": "0",
            "maxspeed": "153600",
        }
        self._volatile = dict(self.settings)

    def power_cycle(self, now: float) -> None:
        """The reference is lost, settings of the session are the stored ones again."""
        super().power_cycle(now)
        self.settings = dict(self._volatile)
        self.spindle.power_cycle(now)

    def answers(self, command: str, now: float) -> list[Timed]:
        """At most one line."""
        answer = self._answer(command, now)
        return [(LATENCY_S, answer)] if answer else []

    def _answer(self, line: str, now: float) -> bytes:
        start = line.rfind("/")
        if start < 0:
            return b""
        body, colon, check = line[start:].rpartition(":")
        if colon and check != checksum(body[1:]):
            return b""
        found = COMMAND.fullmatch(body if colon else line[start:])
        if found is None or int(found[1] or 0) not in (0, self.address):
            return b""
        axis, number = int(found[2] or 0), found[3]
        accepted, data = self._do(found[4].split(), now) if axis <= 1 else (False, "BADAXIS")
        busy = "BUSY" if self.spindle.busy(now) else "IDLE"
        fields = [f"@{self.address:02d}", str(axis), *([] if number is None else [number])]
        fields += ["OK" if accepted else "RJ", busy, self.warnings(now)[0], data]
        reply = " ".join(fields)
        if self.settings.get("comm.checksum") == "1":
            reply += ":" + checksum(reply[1:])
        return f"{reply}\r\n".encode("ascii")

    def warnings(self, now: float) -> list[str]:
        """Flags, the most important first."""
        self.spindle.busy(now)
        stalled = self.spindle.stalled and not self.spindle.busy(now)
        flags = {"FH": self.emergency_stop, "FD": not self.driver_on, "FS": stalled}
        flags |= {"WR": not self.spindle.homed, "NI": self.interrupted}
        return [flag for flag, on in flags.items() if on] or ["--"]

    def _do(self, words: list[str], now: float) -> tuple[bool, str]:
        """A command: accepted or not, and the data of the answer."""
        moving = not self.emergency_stop and self.driver_on
        match words:
            case []:
                return True, "0"
            case ["get", "pos"]:
                return True, str(round(self.spindle.position(now) * self.microsteps_per_deg))
            case ["get", name] if name in self.settings:
                return True, self.settings[name]
            case ["set", name, value] if name in self.settings and name in ("comm.checksum", "comm.alert", "maxspeed"):
                self.settings[name] = value
                return True, "0"
            case ["home"]:
                if moving:
                    self.spindle.go(0.0, now, homing=True)
                return moving, "0" if moving else "BADDATA"
            case ["move", "abs", number] if re.fullmatch(r"-?\d+", number):
                possible = moving and self.spindle.homed and abs(int(number)) <= MAX_POSITION
                if possible:
                    self.spindle.go(int(number) / self.microsteps_per_deg, now)
                return possible, "0" if possible else "BADDATA"
            case ["stop"] | ["estop"]:
                self.interrupted = self.spindle.busy(now)
                self.spindle.stop(now)
                return True, "0"
            case ["warnings", *clear] if clear in ([], ["clear"]):
                flags = [flag for flag in self.warnings(now) if flag != "--"]
                if clear:
                    self.interrupted = False
                    self.spindle.stalled &= self.spindle.busy(now)  # what is still to come is not cleared
                return True, " ".join([f"{len(flags):02d}", *flags])
            case _:
                return False, "BADCOMMAND"
