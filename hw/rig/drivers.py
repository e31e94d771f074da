"""The drivers that a rig needs, whoever wrote them, and how all of them go dark or are closed at once."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from hw.base.clock import Clock, side_by_side
from hw.base.errors import SwitchedOff, Unplugged
from hw.devices.turning import TurntableDriver
from hw.safety.signals import uninterrupted

log = logging.getLogger(__name__)

HEARD_S = 0.02  # until a device has understood what was sent without waiting for an answer


class Closable(Protocol):
    """Any driver."""

    def close(self) -> None: ...


class LaserDriver(Protocol):
    """A laser's driver (`hw.devices.omicron.OmicronLaser`)."""

    @property
    def name(self) -> str: ...
    def arm(self, power_mw: float) -> None: ...
    def emit(self) -> None: ...
    def require_power(self, tolerance: float) -> float:
        """The laser's own reading in mW, refused where it is not its set point within this share."""

    def require_off(self) -> float:
        """The laser's own reading in mW, refused where it is not dark."""

    def darken(self) -> None:
        """Send the command for darkness without waiting for the answer."""

    def close(self) -> None:
        """Switch off, confirmed, and give the port back."""


class Board(Protocol):
    """The driver of mirrors, TTL lines and photodiode (`hw.devices.mm_ard.MirrorBoard`)."""

    def when_lost(self, action: Callable[[], None]) -> None:
        """What to do when an answer was lost, before anything is repeated."""

    def set_mirrors(self, u: int, v: int) -> None: ...
    def set_lines(self, pattern: int) -> None: ...
    def lines(self) -> int: ...
    def darken(self) -> None:
        """Send the command for every line low without waiting for the answer."""

    def shut(self) -> None:
        """Every line low, confirmed; a board does so when it is connected."""

    def counts(self, pin: int) -> int: ...
    def close(self) -> None:
        """Shut every line, confirmed, and give the port back."""


@dataclass(frozen=True)
class Drivers:
    """Drivers that are connected; the lasers in the order of the rig file."""

    lasers: Sequence[LaserDriver]
    board: Board
    table: TurntableDriver
    clock: Clock

    def darken(self) -> None:
        """Tell gates and lasers to go dark, without waiting for answers."""
        darken(self.clock, self.board, self.lasers)

    def close(self) -> None:
        """Switch everything off and give the ports back."""
        close_all(self.clock, [self.board, *self.lasers, self.table])


def darken(clock: Clock, board: Board, lasers: Sequence[LaserDriver]) -> None:
    """Tell gates and lasers to go dark, without waiting for answers; returns when they have had the time to obey."""
    interruptions = _each(clock, [board.darken, *(laser.darken for laser in lasers)])
    clock.sleep(HEARD_S)
    for interruption in interruptions:
        raise interruption


def close_all(clock: Clock, devices: Sequence[Closable]) -> None:
    """Close them side by side, whatever the others raise; Ctrl-C waits until then."""
    with uninterrupted():
        for interruption in _each(clock, [device.close for device in devices]):
            raise interruption


def _each(clock: Clock, steps: Sequence[Callable[[], None]]) -> list[BaseException]:
    """Take every step, whatever the others raise, and at once where the clock is real. What interrupted any of them."""
    interruptions: list[BaseException] = []

    def attempt(step: Callable[[], None]) -> None:
        try:
            step()
        except Unplugged as error:
            quiet = error.known or isinstance(error, SwitchedOff)  # the supervisor was faster, and reports if it fails
            log.log(logging.INFO if quiet else logging.ERROR, "making the rig safe: %s", error)
        except Exception as error:  # noqa: BLE001 - the other devices matter more
            log.error("making the rig safe: %s", error)
        except BaseException as error:  # noqa: BLE001 - raised when the other devices are off
            interruptions.append(error)

    side_by_side(clock, [partial(attempt, step) for step in steps])
    return interruptions
