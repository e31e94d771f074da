"""The rig as an interface: lasers, projector, turntable, cameras and photodiode as the capture loop uses them.

The twin and real devices implement the same protocols. Units: radians, watts, seconds, projector steps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

from hw.record import RawImage


@dataclass(frozen=True)
class Aim:
    """A laser spot: turntable angle (index into the plan's angles) and mirror steps (0 .. 4095 each)."""

    angle: int
    u: int
    v: int


@dataclass(frozen=True)
class LaserReading:
    """One laser with every gate shut, in watts: what it is set to, its own reading, its photodiode's in the dark."""

    set_w: float
    own_w: float
    dark_w: float


class Laser(Protocol):
    @property
    def wavelength_nm(self) -> float: ...
    def open_gate(self) -> None:
        """Let light out. The rig refuses a second open gate."""

    def close_gate(self) -> None: ...
    def darken(self) -> None:
        """Tell the light to go out, without waiting for anybody's answer. Never raises."""


@contextmanager
def gate_open(laser: Laser) -> Iterator[None]:
    """The laser's gate open; shut again whatever happens, even if opening failed half-way."""
    try:
        laser.open_gate()
        yield
    except BaseException:
        laser.darken()  # a gate that does not answer keeps its closing waiting for seconds
        raise
    finally:
        laser.close_gate()


class Projector(Protocol):
    def move(self, u: int, v: int) -> None:
        """Aim both mirrors; returns when they have settled. Refused while a gate is open."""


class Turntable(Protocol):
    def move(self, angle_rad: float) -> None:
        """Turn to an angle, counter-clockwise from above; returns when it stands still."""


class Camera(Protocol):
    @property
    def name(self) -> str: ...
    def expose(self) -> RawImage: ...


class Photodiode(Protocol):
    def read(self) -> float:
        """Mean optical power in watts of the open laser over the last exposure."""


class Floodlight(Protocol):
    def on(self) -> None: ...
    def off(self) -> None: ...


class Rig(Protocol):
    """Every device, powered between `__enter__` and `__exit__`; leaving it for any reason ends in `make_safe`."""

    lasers: Sequence[Laser]
    projector: Projector
    turntable: Turntable
    cameras: Sequence[Camera]
    photodiode: Photodiode
    floodlight: Floodlight

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.make_safe()

    def now(self) -> float:
        """Seconds since the rig was switched on (the twin: a virtual clock)."""

    def resume_at(self, time_s: float) -> None:
        """Continue an interrupted capture whose last image was stored at `time_s`."""

    def announce(self, aims: Sequence[Aim]) -> None:
        """The spots that will be asked for: lets a simulated rig work ahead. Real rigs ignore it."""

    def check(self) -> Sequence[LaserReading]:
        """Asked for before every view, in the dark: refuses a rig whose lasers are not what they were set to.

        What was read, one a laser; nothing from a rig whose lasers have no reading of their own.
        """

    def make_safe(self) -> None:
        """Gates shut, lasers off, floodlight off. Never raises."""
