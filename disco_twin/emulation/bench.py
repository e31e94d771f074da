"""The bench that emulated devices stand on: their states move the twin's, and the twin's cameras see it.

DAC values aim the simulated beam, emission and gate light it, the turntable turns the object. Two clocks: the twin's is
the record's (fixed amounts for frames and turns, as in the direct twin); the link's passes with every byte, wait and
move. Serial traffic of an image fits into the frame that is discarded anyway, and a turn into the twin's time for one:
`docs/decisions/0030-two-clocks.md`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from disco_twin.emulation.twin_rig import FRAMES_PER_IMAGE, TURN_S, TwinRig
from disco_twin.firmware.mm_ard import MirrorHead
from disco_twin.firmware.omicron import LaserHead
from disco_twin.firmware.turning import Spindle
from hw.base.clock import Clock
from hw.base.errors import DiscoError, InputError
from hw.devices.mm_ard import LINES, STEPS
from hw.devices.omicron_protocol import Mode
from hw.interface import Camera
from hw.record import RawImage
from hw.rig.limits import Subscriber

FLOOD_LINE = LINES - 1  # the lasers' gates are lines 0, 1, 2
LAMP_LINE = LINES - 2  # the warning lamp: high as long as the rig is armed
AT_ANGLE_DEG = 0.01  # the object stands at a configured angle if it is as close as this


class Bench:
    """A twin whose lasers, mirrors, gates, photodiode and turntable are emulated devices.

    `hazards` lists what must never happen, whether light falls through or not. It is looked for whenever a line
    changes, anything is moved, a laser starts or its port is given back: two gates at once; a gate open while mirrors
    or turntable move; a laser that starts, or shines, without the warning lamp, or starts behind an open gate; a laser
    that emits though nobody holds its port.

    Raises: InputError for more mirror steps than the board has.
    """

    def __init__(self, twin: TwinRig, clock: Clock) -> None:
        config = twin.config
        if config.projector.steps > STEPS:
            problem, key = "more mirror steps than the emulated board's DAC has", "rig.projector.steps"
            raise InputError(problem, key=key, value=config.projector.steps, allowed=f"at most {STEPS}",
                             remedy="fewer steps, or a capture by the twin")  # fmt: skip
        self.twin, self.clock = twin, clock
        self.heads = [LaserHead(laser.wavelength_nm, laser.power_mw) for laser in config.lasers]
        for index, head in enumerate(self.heads):
            head.on_start = partial(self._started, index)
        self.board = MirrorHead(
            sample=self._counts, on_move=partial(self._require_shut, "the mirrors"), on_lines=self._lines_changed
        )
        self.spindle = Spindle(on_move=self.turned)
        self.cameras: list[Camera] = [BenchCamera(self, camera, camera.name) for camera in twin.cameras]
        self.hazards: list[str] = []
        nominal = twin.watts
        twin.watts = lambda laser, time_s: nominal(laser, time_s) * self._share(laser)

    # ---- what the devices do to the twin

    def _share(self, laser: int) -> float:
        """Of the nominal power, that leaves the head now."""
        head = self.heads[laser]
        return head.emission(self.clock.now()) * (head.max_power_mw / self.twin.config.lasers[laser].power_mw)

    def light(self) -> list[int]:
        """The lasers whose light falls on the object now."""
        return [i for i in range(len(self.heads)) if self.board.lines >> i & 1 and self._share(i) > 0.0]

    # ---- what must never happen

    def _gates(self) -> list[int]:
        return [i for i in range(len(self.heads)) if self.board.lines >> i & 1]

    def _lamp(self) -> bool:
        return bool(self.board.lines >> LAMP_LINE & 1)

    def _require_shut(self, what: str) -> None:
        if self._gates():
            self.hazards.append(f"{what} moved with open gates {self._gates()}")

    def _lines_changed(self) -> None:
        gates, now = self._gates(), self.clock.now()
        if len(gates) > 1:
            self.hazards.append(f"gates {gates} are open at once")
        for what, moves in (("a mirror", not self.board.settled(now)), ("the turntable", self.spindle.busy(now))):
            if gates and moves:
                self.hazards.append(f"gates {gates} are open while {what} still moves")
        if self.light() and not self._lamp():
            self.hazards.append(f"laser {self.light()} shines without the warning lamp")

    def _started(self, laser: int) -> None:
        if not self._lamp():
            self.hazards.append(f"laser {laser} is started without the warning lamp")
        if laser in self._gates():
            self.hazards.append(f"laser {laser} is started behind an open gate")

    def left(self, laser: int) -> None:
        """Nobody holds a laser's port any more."""
        if self._share(laser) > 0.0:
            self.hazards.append(f"laser {laser} emits and nobody holds its port")

    def turned(self, angle_deg: float) -> None:
        """The turntable has been sent to an angle; the twin's clock is charged for a turn to another one."""
        self._require_shut("the turntable")
        angles = np.asarray(self.twin.config.turntable_angles_deg)
        away = np.abs(np.remainder(angle_deg - angles + 180.0, 360.0) - 180.0)
        nearest = int(np.argmin(away))
        if away[nearest] < AT_ANGLE_DEG and nearest != self.twin.scene.angle:
            self.twin.clock += TURN_S
            self.twin.alter(angle=nearest)

    def _counts(self, pin: int) -> int:
        """The converter holds the mean over the last exposure while its laser is lit."""
        return self.twin.counts if self.light() == [pin] else 0

    def look(self) -> None:
        """Put the twin into the state that the devices are in.

        Raises: DiscoError where a device is in a state that was not simulated.
        """
        now, light = self.clock.now(), self.light()
        if len(light) > 1:
            raise DiscoError(f"the simulated camera sees lasers {light} at once")
        if light and not self.board.settled(now):
            raise DiscoError("the simulated camera sees the mirrors moving")
        angle = self.twin.config.turntable_angles_deg[self.twin.scene.angle]
        away = abs((self.spindle.position(now) - angle + 180.0) % 360.0 - 180.0)
        if away >= AT_ANGLE_DEG or self.spindle.busy(now):
            raise DiscoError(f"the twin has no light for a turntable at {self.spindle.position(now):.2f} deg")
        u, v = (int(galvo.position(now)) for galvo in self.board.galvos)
        flood = bool(self.board.lines >> FLOOD_LINE & 1)
        self.twin.alter(u=u, v=v, gate=light[0] if light else -1, flood=flood)


@dataclass
class BenchCamera:
    """A simulated camera in front of emulated devices: one discarded frame, one that counts."""

    bench: Bench
    twin: Camera
    name: str

    def expose(self) -> RawImage:
        """What the twin's camera sees of the bench."""
        frame = self.bench.twin.config.sensor.longest_exposure_s
        self.bench.clock.sleep((FRAMES_PER_IMAGE - 1) * frame)
        self.bench.look()
        raw = self.twin.expose()
        self.bench.clock.sleep(frame)
        return raw


@dataclass
class MirroredDevices(Subscriber):
    """A bench whose devices do as real ones do: a real turntable turns the simulated object."""

    bench: Bench

    def laser(self, index: int, power_mw: float) -> None:
        """The twin's laser emits this power, as long as it takes the real one to be steady behind it."""
        head = self.bench.heads[index]
        head.level, head.mode = power_mw / head.max_power_mw, int(Mode.BIAS | Mode.RELEASE)
        head.on_since = -np.inf if power_mw else None

    def mirrors(self, u: int, v: int) -> None:
        """The twin's mirrors go there."""
        for channel, value in enumerate((u, v)):
            self.bench.board.write(channel, value, self.bench.clock.now())

    def lines(self, pattern: int) -> None:
        """The twin's gates and lamps, too."""
        self.bench.board.set_pattern(pattern)

    def turntable(self, angle_rad: float) -> None:
        """The twin's object stands there."""
        angle_deg = float(np.rad2deg(angle_rad))
        self.bench.spindle = Spindle(angle_deg=angle_deg, homed=True, on_move=self.bench.turned)
        self.bench.turned(angle_deg)
