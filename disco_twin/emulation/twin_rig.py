"""The twin of the DISCO rig behind hw's interface: lasers, projector, turntable, cameras, photodiode, floodlight.

Time is a virtual clock that exposures and the turntable advance by fixed amounts: a capture that was interrupted, put
back to where it was and resumed meets the same times (and noise) as one that was not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np

from disco_twin.camera.lars3 import Lars3
from disco_twin.faults.actual_rig import ActualRig, actual_rig
from disco_twin.faults.light_faults import LaserPower, Stream, generator, speckle
from disco_twin.scene.rig_schema import TwinRigConfig
from hw.base.arrays import F32
from hw.base.errors import DiscoError, InputError, Refused
from hw.devices.mm_ard import ADC_TOP
from hw.interface import Aim, LaserReading, Rig, Turntable
from hw.record import RawImage
from pipeline.geometry.nominal_rig import LaserConfig

FRAMES_PER_IMAGE = 2  # every other frame is discarded while the mirrors move (thesis 4.1)
TURN_S = 8.0  # turning to another angle and coming to rest
EXCHANGE_S = 20.0  # taking a calibration target away and putting the next one up
PHOTODIODE_NOISE = 1e-3  # of the reading, standard deviation
PHOTODIODE_RANGE = 2.0  # top of its converter, in the laser's nominal power


class ResponseSource(Protocol):
    """Where the twin's light comes from."""

    def prepare(self, aims: Sequence[Aim]) -> None:
        """These spots will be asked for."""

    def image(self, camera: int, aim: Aim, laser: int) -> F32:
        """(height, width) radiance in 1/(mm^2 sr), per watt of laser power."""

    def silhouette(self, camera: int, angle: int) -> F32:
        """(height, width) radiance in W/(mm^2 sr) under the floodlight, at the first laser's wavelength."""


@dataclass(frozen=True)
class _Scene:
    """All that an image depends on, apart from the camera and time. gate: the open laser or -1."""

    angle: int
    u: int
    v: int
    gate: int = -1
    flood: bool = False


def watts_per_count(laser: LaserConfig) -> float:
    """Of the photodiode's 10-bit converter (the MM-Ard board's), whose gain is set for each laser."""
    return PHOTODIODE_RANGE * laser.power_mw * 1e-3 / ADC_TOP


class TwinRig(Rig):
    """`hw.interface.Rig` without hardware: nominal `config`, light from `source`, everything random from `seed`."""

    def __init__(
        self, config: TwinRigConfig, source: ResponseSource, seed: int, actual: ActualRig | None = None
    ) -> None:
        actual = actual_rig(config, seed) if actual is None else actual
        self.config, self.source, self.seed, self.actual = config, source, seed, actual
        self.watts: Callable[[int, float], float] = LaserPower(config.lasers, config.faults, seed).watts
        self.lasers = [TwinLaser(self, i, laser.wavelength_nm) for i, laser in enumerate(config.lasers)]
        self.projector = TwinProjector(self)
        self.turntable: Turntable = TwinTurntable(self)
        self.cameras = [
            TwinCamera(self, i, nominal.name, Lars3.of(config, camera))
            for i, (nominal, camera) in enumerate(zip(config.cameras, actual.cameras, strict=True))
        ]
        self.photodiode = TwinPhotodiode(self)
        self.floodlight = TwinFloodlight(self)
        self.powered = False
        self.clock = 0.0
        self.scene = self._home = _Scene(0, config.projector.steps // 2, config.projector.steps // 2)
        self.counts, self.reading = 0, 0.0
        self._exposed: dict[int, tuple[_Scene, int]] = {}  # camera -> its last scene and how often it saw it before

    def __enter__(self) -> Self:
        self.restart()
        return self

    def restart(self) -> None:
        """Power on, at time 0 (`hw.base.clock.Timebase`)."""
        self.powered, self.clock, self.scene = True, 0.0, self._home
        self.counts, self.reading = 0, 0.0
        self._exposed.clear()

    def exponent(self) -> int | None:
        """The exposure that all pixels take; None: each decides for itself."""
        return None

    def now(self) -> float:
        """Seconds on the virtual clock since the rig was switched on."""
        return self.clock

    def resume_at(self, time_s: float) -> None:
        """Set the clock to the time when the last image had been exposed."""
        self.clock = time_s

    def announce(self, aims: Sequence[Aim]) -> None:
        """Let the light source work ahead."""
        self.source.prepare(aims)

    def check(self) -> Sequence[LaserReading]:
        """Simulated lasers have no reading of their own."""
        self.require_power()
        return ()

    def make_safe(self) -> None:
        """Gates shut, lasers off, floodlight off."""
        self.alter(gate=-1, flood=False)
        self.powered = False

    def require_power(self) -> None:
        """Refuse to do anything outside `with rig:`. Raises: Refused."""
        if not self.powered:
            raise Refused("the rig is switched off. Remedy: use it inside `with rig:`")

    def require_dark(self, what: str) -> None:
        """Refuse to move anything while laser light is let out. Raises: Refused."""
        self.require_power()
        if self.scene.gate >= 0:
            raise Refused(
                f"the {what} must not move while the gate of laser {self.scene.gate} is open. Remedy: shut it first"
            )

    def repeats(self, camera: int) -> int:
        """How many exposures in a row, before the one that is due, this camera has made of the unchanged scene."""
        scene, count = self._exposed.get(camera, (None, -1))
        count = count + 1 if scene == self.scene else 0
        self._exposed[camera] = (self.scene, count)
        return count

    def alter(self, **changes: int | bool) -> None:
        """Change the state of the rig (`_Scene`); what is not named stays."""
        self.scene = replace(self.scene, **changes)  # type: ignore[arg-type]


@dataclass
class TwinLaser:
    """One laser behind its gate."""

    rig: TwinRig
    index: int
    wavelength_nm: float

    def open_gate(self) -> None:
        """Let light out; refused while another gate is open. Raises: Refused."""
        self.rig.require_power()
        if self.rig.scene.gate not in (-1, self.index):
            raise Refused(
                f"the gate of laser {self.rig.scene.gate} is open: one laser at a time. Remedy: shut it first"
            )
        self.rig.alter(gate=self.index)

    def close_gate(self) -> None:
        """Shut this gate; always allowed."""
        if self.rig.scene.gate == self.index:
            self.rig.alter(gate=-1)

    def darken(self) -> None:
        """A simulated gate shuts at once."""
        self.close_gate()


@dataclass
class TwinProjector:
    """The two mirrors. Their moves take place during the discarded frame of the next image."""

    rig: TwinRig

    def move(self, u: int, v: int) -> None:
        """Aim at mirror steps (u, v). Raises: InputError."""
        self.rig.require_dark("projector")
        steps = self.rig.config.projector.steps
        for name, value in (("u", u), ("v", v)):
            if not 0 <= value < steps:
                raise InputError("no such mirror step", key=name, value=value, allowed=f"0 to {steps - 1}",
                                 remedy="aim at another one")  # fmt: skip
        self.rig.alter(u=int(u), v=int(v))


@dataclass
class TwinTurntable:
    """Stands at the configured angles only: light was simulated for no others."""

    rig: TwinRig

    def move(self, angle_rad: float) -> None:
        """Turn to one of the configured angles. Raises: InputError."""
        self.rig.require_dark("turntable")
        angles = np.deg2rad(self.rig.config.turntable_angles_deg)
        away = np.abs(np.remainder(angle_rad - angles + np.pi, 2 * np.pi) - np.pi)
        nearest = int(np.argmin(away))
        if not away[nearest] < 1e-6:
            value = round(float(np.rad2deg(angle_rad)), 6)
            allowed = ", ".join(f"{a:g}" for a in self.rig.config.turntable_angles_deg)
            problem = "the twin has no light for this turntable angle"
            remedy = "turn to one of these"
            raise InputError(problem, key="angle_deg", value=value, allowed=allowed, remedy=remedy)
        if nearest != self.rig.scene.angle:
            self.rig.clock += TURN_S
        self.rig.alter(angle=nearest)


class TargetRig(TwinRig):
    """One camera of the twin, with targets in the object's place: the "turntable" is a person who exchanges them."""

    def __init__(
        self, config: TwinRigConfig, source: ResponseSource, seed: int, actual: ActualRig, camera: int, placements: int
    ) -> None:
        only = slice(camera, camera + 1)
        config = config.model_copy(update={"cameras": config.cameras[only]})
        one = replace(actual, cameras=actual.cameras[only], response=actual.response[only])
        super().__init__(config, source, seed, one)
        self.turntable = TwinTargetHolder(self, placements)


class BracketRig(TargetRig):
    """One camera of the twin before a board that stays; "placement" k is an exposure of 2^-k of the longest."""

    def exponent(self) -> int | None:
        return self.scene.angle


@dataclass
class TwinTargetHolder:
    """Puts target number `angle_rad` in place."""

    rig: TwinRig
    placements: int

    def move(self, angle_rad: float) -> None:
        """Exchange the target, if it is not there yet. Raises: InputError."""
        self.rig.require_dark("target")
        if not 0 <= angle_rad < self.placements or angle_rad != int(angle_rad):
            raise InputError("no such target", key="placement", value=angle_rad, allowed=f"0 to {self.placements - 1}",
                             remedy="place one of these")  # fmt: skip
        if int(angle_rad) != self.rig.scene.angle:
            self.rig.clock += EXCHANGE_S
        self.rig.alter(angle=int(angle_rad))


@dataclass
class TwinCamera:
    """One camera. Its noise depends on what it sees, and differs between exposures in a row of an unchanged scene."""

    rig: TwinRig
    index: int
    name: str
    optics: Lars3

    def expose(self) -> RawImage:
        """Discard a frame, take a frame."""
        rig, scene = self.rig, self.rig.scene
        rig.require_power()
        u, v = (scene.u, scene.v) if scene.gate >= 0 else (0, 0)  # where the mirrors stand in the dark does not matter
        address = (self.index, scene.angle, u, v, scene.gate + 1, int(scene.flood))
        repeats = rig.repeats(self.index)
        frame = rig.config.sensor.longest_exposure_s
        watts = 0.0 if scene.gate < 0 else rig.watts(scene.gate, rig.clock + (FRAMES_PER_IMAGE - 0.5) * frame)
        noise = generator(rig.seed, Stream.PHOTODIODE, *address, repeats).standard_normal()
        raw = self.optics.expose(
            self._radiance(watts, address),
            max(scene.gate, 0),
            generator(rig.seed, Stream.SENSOR, *address, repeats),
            rig.exponent(),
        )
        gain = 1.0 if scene.gate < 0 else rig.actual.photodiode[scene.gate]
        scale = watts_per_count(rig.config.lasers[max(scene.gate, 0)])
        rig.counts = min(max(round(watts * gain * (1.0 + PHOTODIODE_NOISE * float(noise)) / scale), 0), ADC_TOP)
        rig.reading = rig.counts * scale
        rig.clock += FRAMES_PER_IMAGE * frame
        return raw

    def _radiance(self, watts: float, address: tuple[int, ...]) -> F32:
        """(height, width) radiance in front of the lens."""
        rig, scene = self.rig, self.rig.scene
        camera = rig.config.cameras[self.index]
        radiance = np.zeros((camera.height, camera.width), np.float32)
        if scene.gate >= 0:
            light = rig.source.image(self.index, Aim(scene.angle, scene.u, scene.v), scene.gate) * np.float32(watts)
            if rig.config.faults.speckle:
                light = light * speckle(light.shape, generator(rig.seed, Stream.SPECKLE, *address))
            radiance = radiance + light
        if scene.flood:
            radiance = radiance + rig.source.silhouette(self.index, scene.angle)
        radiance = radiance * np.float32(rig.actual.response[self.index, max(scene.gate, 0)])
        if not (radiance.min() >= 0.0 and np.isfinite(radiance.max())):
            raise DiscoError(f"the simulated light of camera {self.name} at {scene} is negative or not finite")
        return radiance


@dataclass
class TwinPhotodiode:
    """Reads the open laser's mean power over the last exposure, with noise and in the steps of its converter."""

    rig: TwinRig

    def read(self) -> float:
        """Watts; 0 when the last exposure was taken without laser light."""
        self.rig.require_power()
        return self.rig.reading


@dataclass
class TwinFloodlight:
    """The spotlights that fully illuminate the object for a silhouette image (thesis 4.1)."""

    rig: TwinRig

    def on(self) -> None:
        """Switch on."""
        self.rig.require_power()
        self.rig.alter(flood=True)

    def off(self) -> None:
        """Switch off; always allowed."""
        self.rig.alter(flood=False)
