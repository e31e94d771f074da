"""A rig in memory for the tests of the capture: a virtual clock, images that depend on everything that can go wrong.

Every image depends on camera, angle, mirrors, open gate and clock, so that a wrong order, a state that was not restored
or a clock that is off by one action changes the stream's bytes. Every rule of safety is asserted as it is used.
"""

from __future__ import annotations

import math
import multiprocessing
import warnings
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from hw.interface import Aim, LaserReading
from hw.record import RawImage
from pipeline.capture.laser_log import LASERS
from pipeline.plan.plan import Plan

SHAPE = (10, 16)


def small_plan(spots_per_angle: Sequence[int] = (3, 0, 4), cameras: int = 2, lasers: int = 3) -> Plan:
    """A plan with an angle that has no spot at all."""
    aims = [Aim(angle, 100 * k + angle, 7 * k) for angle, n in enumerate(spots_per_angle) for k in range(n)]
    names = tuple(f"camera{c}" for c in range(cameras))
    angles = tuple(float(a) for a in np.arange(len(spots_per_angle)) * 0.7)
    return Plan(names, angles, tuple(aims), lasers)


def frame(shape: tuple[int, int], seed: int) -> RawImage:
    """A random record with a bright corner."""
    random = np.random.default_rng(seed)
    charge = np.clip(np.rint(64 + random.standard_normal(shape)), 0, 4095).astype(np.uint16)
    exponent = np.zeros(shape, np.uint8)
    exponent[: shape[0] // 4, : shape[1] // 4] = 7
    return RawImage(exponent, charge)


@dataclass
class FakeRig:
    """`on_expose` runs before every exposure: tests raise or send signals there."""

    plan: Plan
    on_expose: Callable[[FakeRig], None] = lambda rig: None
    clock: float = 0.0
    angle: float = 0.0
    mirrors: tuple[int, int] = (0, 0)
    open: int = -1
    flood: bool = False
    powered: bool = False
    made_safe: int = 0
    exposures: int = 0
    announced: list[tuple[Aim, ...]] = field(default_factory=list)
    checks: list[int] = field(default_factory=list)  # exposures by then
    readings: Callable[[], Sequence[LaserReading]] = tuple

    def __post_init__(self) -> None:
        self.lasers = [FakeLaser(self, i) for i in range(self.plan.lasers)]
        self.cameras = [FakeCamera(self, name) for name in self.plan.cameras]
        self.turntable, self.projector = FakeTurntable(self), FakeProjector(self)
        self.photodiode, self.floodlight = FakePhotodiode(self), FakeFloodlight(self)

    def __enter__(self) -> Self:
        self.powered, self.clock = True, 60.0  # warm-up (thesis 4.2)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.make_safe()

    def now(self) -> float:
        return self.clock

    def resume_at(self, time_s: float) -> None:
        self.clock = time_s

    def announce(self, aims: Sequence[Aim]) -> None:
        self.announced.append(tuple(aims))

    def check(self) -> Sequence[LaserReading]:
        assert self.powered and self.dark
        self.checks.append(self.exposures)
        return self.readings()

    def make_safe(self) -> None:
        self.open, self.flood, self.powered = -1, False, False
        self.made_safe += 1

    @property
    def dark(self) -> bool:
        return self.open < 0 and not self.flood

    def power(self) -> float:
        """Watts: drifts with the clock."""
        return 0.01 * (1 + 0.1 * math.sin(self.clock)) * (self.open + 1)


@dataclass
class FakeLaser:
    rig: FakeRig
    number: int
    wavelength_nm: float = 635.0

    def open_gate(self) -> None:
        assert self.rig.powered
        assert self.rig.dark
        self.rig.open = self.number
        self.rig.clock += 0.001

    def close_gate(self) -> None:
        self.rig.open = -1
        self.rig.clock += 0.002

    def darken(self) -> None:
        self.rig.open = -1


@dataclass
class FakeTurntable:
    rig: FakeRig

    def move(self, angle_rad: float) -> None:
        assert self.rig.powered
        assert self.rig.dark
        self.rig.clock += 0.1 + abs(angle_rad - self.rig.angle)
        self.rig.angle = angle_rad


@dataclass
class FakeProjector:
    rig: FakeRig

    def move(self, u: int, v: int) -> None:
        assert self.rig.powered
        assert self.rig.dark
        self.rig.clock += 1e-5 * (abs(u - self.rig.mirrors[0]) + abs(v - self.rig.mirrors[1]))
        self.rig.mirrors = (u, v)


@dataclass
class FakeCamera:
    rig: FakeRig
    name: str

    def expose(self) -> RawImage:
        rig = self.rig
        rig.on_expose(rig)
        assert rig.powered
        assert not rig.dark
        rig.exposures += 1
        rig.clock += 1 / 30
        state = repr((self.name, rig.angle, rig.mirrors if rig.open >= 0 else None, rig.open, rig.flood, rig.power()))
        return frame(SHAPE, zlib.crc32(state.encode()))


@dataclass
class FakePhotodiode:
    rig: FakeRig

    def read(self) -> float:
        assert self.rig.open >= 0
        self.rig.clock += 0.0005
        return float(self.rig.power())


@dataclass
class FakeFloodlight:
    rig: FakeRig

    def on(self) -> None:
        assert self.rig.powered
        assert self.rig.dark
        self.rig.flood = True

    def off(self) -> None:
        self.rig.flood = False


def fork(target: Callable[..., None], *args: object) -> BaseProcess:
    """A started child process that shares this one's modules: no second import to wait for."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # a process with threads; the child uses none of them
        child = multiprocessing.get_context("fork").Process(target=target, args=args)
        child.start()
    return child


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a capture folder but the lasers' own readings, which are no part of the images."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.name != LASERS}
