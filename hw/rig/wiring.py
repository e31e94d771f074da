"""What a serial rig is made of: the drivers that it needs, and what is wired to what."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from hw.devices.turning import Table


class Closable(Protocol):
    """Any driver."""

    def close(self) -> None: ...


class LaserDriver(Protocol):
    """A laser's driver (`hw.devices.omicron.OmicronLaser`, or a guard in front of it)."""

    @property
    def name(self) -> str: ...
    def arm(self, power_mw: float) -> None: ...
    def emit(self) -> None: ...
    def require_guard(self) -> None: ...
    def require_power(self, tolerance: float) -> float:
        """The laser's own reading in mW, refused where it is not its set point within this share."""

    def off_now(self) -> None:
        """Say off without waiting for the answer."""

    def close(self) -> None:
        """Switch off, confirmed, and give the port back."""


class Board(Protocol):
    """The driver of mirrors, TTL lines and photodiode (`hw.devices.mm_ard.MirrorBoard`)."""

    def when_lost(self, action: Callable[[], None]) -> None:
        """What to do when an answer was lost, before anything is repeated."""

    def set_mirrors(self, u: int, v: int) -> None: ...
    def set_lines(self, pattern: int) -> None: ...
    def lines(self) -> int: ...
    def shut_now(self) -> None: ...
    def shut(self) -> None:
        """Every line low, confirmed; a board does so when it is connected."""

    def counts(self, pin: int) -> int: ...
    def close(self) -> None:
        """Shut every line, confirmed, and give the port back."""


@dataclass(frozen=True)
class LaserWiring:
    """One laser: its gate's TTL line, its photodiode's ADC pin, watts on the object per ADC count, and its power.

    `limits`: the photodiode's reading must lie within these shares of the power, or the image is refused.
    """

    wavelength_nm: float
    power_mw: float
    gate_line: int
    pin: int
    watts_per_count: float
    limits: tuple[float, float] = (0.1, 1.5)


@dataclass(frozen=True)
class Devices:
    """Drivers that are connected, the lasers in the order of the wiring."""

    heads: Sequence[LaserDriver]
    board: Board
    table: Table
