"""Real devices as the rig file wants them, and as simulated cameras must see them.

Limits, zero and direction of the rig file are kept here; `Followed...` also tell the twin what a real device does, so
that its cameras see it: a real turntable turns the simulated object.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from disco_twin.emulation.bench import Bench
from disco_twin.firmware.turning import Spindle
from hw.base.errors import InputError
from hw.devices.mm_ard import MirrorBoard
from hw.devices.omicron import OmicronLaser
from hw.devices.omicron_protocol import Mode
from hw.devices.turning import Table

# ---- limits of the rig file


@dataclass
class LimitedBoard:
    """A board whose mirrors stay where the rig file lets them."""

    board: MirrorBoard
    limits: tuple[tuple[int, int], tuple[int, int]]

    def when_lost(self, action: Callable[[], None]) -> None:
        """What to do when an answer was lost."""
        self.board.when_lost(action)

    def set_mirrors(self, u: int, v: int) -> None:
        """Refused outside the limits."""
        for name, value, (low, high) in zip("uv", (u, v), self.limits, strict=True):
            if not low <= value <= high:
                raise InputError(
                    "this mirror step is outside the rig's limits",
                    key=f"board.limits_{name}",
                    value=value,
                    allowed=f"{low} to {high}",
                    remedy="widen the limits in the rig file, or aim the scene's projector so that it needs less",
                )
        self.board.set_mirrors(u, v)

    def set_lines(self, pattern: int) -> None:
        """The TTL lines."""
        self.board.set_lines(pattern)

    def lines(self) -> int:
        """The TTL lines as they are."""
        return self.board.lines()

    def shut_now(self) -> None:
        """Every line low, without waiting for the answer."""
        self.board.shut_now()

    def shut(self) -> None:
        """Every line low."""
        self.board.shut()

    def counts(self, pin: int) -> int:
        """The converter's value at a pin."""
        return self.board.counts(pin)

    def close(self) -> None:
        """Shut, and give the port back."""
        self.board.close()


@dataclass
class PlacedTable:
    """A turntable whose own zero and sense of turning differ from the rig's. Angles in rad."""

    table: Table
    zero_rad: float
    direction: int
    told: Callable[[float], None]  # degrees of the rig, after every move

    def __post_init__(self) -> None:
        self.link = self.table.link

    def home(self) -> None:
        """Find the zero, and turn to the rig's."""
        self.table.home()
        self.move(0.0)

    def move(self, angle_rad: float) -> None:
        """Turn to an angle of the rig."""
        self.table.move(self.zero_rad + self.direction * angle_rad)
        self.told(float(np.rad2deg(angle_rad)))

    def angle_rad(self) -> float:
        """Where it stands."""
        return self.direction * (self.table.angle_rad() - self.zero_rad) % (2 * np.pi)

    def close(self) -> None:
        """Stop, and give the port back."""
        self.table.close()


# ---- real devices that simulated cameras must see


@dataclass
class MirroredLaser:
    """A real laser; the twin's head does as it does."""

    head: OmicronLaser
    bench: Bench
    index: int

    @property
    def name(self) -> str:
        """What the rig calls it."""
        return self.head.name

    def arm(self, power_mw: float) -> None:
        """Allow light of this power."""
        self.head.arm(power_mw)
        twin = self.bench.heads[self.index]
        twin.level = power_mw / twin.max_power_mw
        twin.mode = int(Mode.BIAS | Mode.RELEASE)

    def emit(self) -> None:
        """Start emission."""
        self.head.emit()
        self.bench.heads[self.index].on_since = -np.inf

    def require_guard(self) -> None:
        """The real laser's."""
        self.head.require_guard()

    def require_power(self, tolerance: float) -> float:
        """The real laser's own reading."""
        return self.head.require_power(tolerance)

    def off_now(self) -> None:
        """No light, without waiting for the answer."""
        self.bench.heads[self.index].on_since = None
        self.head.off_now()

    def close(self) -> None:
        """Switch off, and give the port back."""
        self.bench.heads[self.index].on_since = None
        self.head.close()


@dataclass
class MirroredBoard(LimitedBoard):
    """A real board; the twin's mirrors and gates do as it does."""

    bench: Bench

    def set_mirrors(self, u: int, v: int) -> None:
        """Both mirrors."""
        super().set_mirrors(u, v)
        for channel, value in enumerate((u, v)):
            self.bench.board.write(channel, value, self.bench.clock.now())

    def set_lines(self, pattern: int) -> None:
        """The TTL lines."""
        super().set_lines(pattern)
        self.bench.board.set_pattern(pattern)

    def shut_now(self) -> None:
        """Every line low, without waiting for the answer."""
        self.bench.board.set_pattern(0)
        super().shut_now()

    def shut(self) -> None:
        """Every line low."""
        self.bench.board.set_pattern(0)
        super().shut()


def turn_twin(bench: Bench) -> Callable[[float], None]:
    """The twin's object stands where a real turntable has put it."""

    def told(angle_deg: float) -> None:
        bench.spindle = Spindle(angle_deg=angle_deg, homed=True, on_move=bench.turned)
        bench.turned(angle_deg)

    return told
