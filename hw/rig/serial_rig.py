"""A rig of real devices behind `hw.interface.Rig`: Omicron lasers, an MM-Ard board, a turntable, cameras.

The board moves the mirrors, opens the gates, switches the floodlight and reads the photodiode. Lasers stay powered
through a scan, since emission takes seconds to start: between images they are dark because their gates are shut.
Whatever is emulated or simulated comes in by the port's name, the cameras and the timebase.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from types import TracebackType
from typing import Self

from hw.base.clock import Clock, Elapsed, Timebase, side_by_side
from hw.base.errors import DeviceFault, Refused, SwitchedOff, Unplugged
from hw.interface import Aim, Camera, Floodlight, Laser, LaserReading, Photodiode, Projector, Turntable
from hw.rig.parts import AdcPhotodiode, GatedLaser, Mirrors, TtlFloodlight, Turning
from hw.rig.verified_board import HEARD_S, VerifiedBoard
from hw.rig.wiring import Board, Closable, Devices, LaserDriver, LaserWiring
from hw.safety.signals import raise_if_interrupted, uninterrupted

log = logging.getLogger(__name__)

GUARDS_EVERY_S = 0.5  # while lasers warm up
DARK_COUNTS = 8  # of the converter's 1023, with every gate shut


class SerialRig:
    """`hw.interface.Rig` over drivers. Devices are connected on entering, so that entering again reconnects."""

    def __init__(
        self,
        connect: Callable[[], Devices],
        wiring: Sequence[LaserWiring],
        cameras: Sequence[Camera],
        clock: Clock,
        *,
        armed: bool,
        flood_line: int | None = None,
        armed_line: int | None = None,
        warm_up_s: float = 0.0,
        power_tolerance: float = 0.1,
        timebase: Timebase | None = None,
        announce: Callable[[Sequence[Aim]], None] | None = None,
        centre: tuple[int, int] = (2048, 2048),
        in_the_dark: Callable[[], object] = lambda: None,
    ) -> None:
        """`connect` shuts every line; if it fails it closes what it opened. `centre`: where the mirrors stand first.

        armed: lasers may emit; without it the rig refuses to be entered, before anything is connected.
        armed_line: a TTL line that is high as long as the rig is on: a warning lamp, and the witness that the board has
        not been reset since (it would have forgotten where the mirrors stand). warm_up_s: from emission to the first
        image; then every laser's own reading must lie within `power_tolerance` of its set point. in_the_dark: what is
        to be measured, and may be refused, while lasers and lamps are off and the gates shut.
        """
        self._connect, self.wiring, self.clock, self._armed = connect, tuple(wiring), clock, armed
        self.flood_line, self._armed_line, self._announce, self._centre = flood_line, armed_line, announce, centre
        self._warm_up_s, self._power_tolerance, self._in_the_dark = warm_up_s, power_tolerance, in_the_dark
        self._timebase: Timebase = Elapsed(clock) if timebase is None else timebase
        self._devices: Devices | None = None
        self._board: VerifiedBoard | None = None
        self.last_open = -1  # the laser whose gate was opened last: whose photodiode is to be read
        self.lasers: Sequence[Laser] = [GatedLaser(self, i) for i in range(len(self.wiring))]
        self.projector: Projector = Mirrors(self)
        self.turntable: Turntable = Turning(self)
        self.cameras: Sequence[Camera] = list(cameras)
        self.photodiode: Photodiode = AdcPhotodiode(self)
        self.floodlight: Floodlight = TtlFloodlight(self)

    # ---- on and off

    def __enter__(self) -> Self:
        """Connect, home, light the warning lamp, then arm the lasers and wait for their emission, behind shut gates."""
        if not self._armed:
            raise Refused(
                "the rig is not armed, and its lasers would emit. Remedy: see to interlock, door and goggles, then arm "
                "it (--arm; in Python armed=True)"
            )
        self._devices = devices = self._connect()
        try:
            gates = [wiring.gate_line for wiring in self.wiring]
            self._board = board = VerifiedBoard(devices.board, self.clock, gates, self.cut)
            self._in_the_dark()
            board.aim(*self._centre)
            devices.table.home()
            if self._armed_line is not None:
                board.switch(self._armed_line, True)
            for head, wiring in zip(devices.heads, self.wiring, strict=True):
                head.arm(wiring.power_mw)
                head.emit()
            warm_up(self.clock, self._warm_up_s, devices.heads)
            self.check()
        except BaseException:
            self.make_safe()
            raise
        self._timebase.restart()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.make_safe()

    def make_safe(self) -> None:
        """Gates shut, lasers and lamps off, ports given back. No device's failure stops another's, or is raised.

        First gates and lasers are told; then each device confirms in being closed, which one that has fallen silent can
        draw out for seconds. Ctrl-C waits until all that is done.
        """
        with uninterrupted():
            devices, self._devices, self._board, self.last_open = self._devices, None, None, -1
            if devices is None:
                return
            try:
                cut_light(self.clock, devices.board, devices.heads)
            finally:
                close_all(self.clock, [devices.board, *devices.heads, devices.table])

    def cut(self) -> None:
        """Tell gates and lasers to go dark without waiting for answers; the rig must be entered anew then."""
        if self._devices is None:
            return
        if self._board is not None:
            self._board.distrusted = True
        cut_light(self.clock, self._devices.board, self._devices.heads)

    @property
    def connected(self) -> bool:
        """Whether the devices are there."""
        return self._devices is not None

    def devices(self) -> Devices:
        """The drivers; refused outside `with rig:`."""
        if self._devices is None:
            raise Refused("the rig is switched off: use it inside `with rig:`")
        return self._devices

    def board(self) -> VerifiedBoard:
        """The board; refused outside `with rig:`."""
        if self._board is None:
            raise Refused("the rig is switched off: use it inside `with rig:`")
        return self._board

    # ---- time

    def now(self) -> float:
        """Seconds since the rig was ready."""
        return self._timebase.now()

    def resume_at(self, time_s: float) -> None:
        """Continue an interrupted capture whose last image was stored at `time_s`."""
        self._timebase.resume_at(time_s)

    def announce(self, aims: Sequence[Aim]) -> None:
        """Simulated cameras work ahead; real ones ignore it."""
        if self._announce is not None:
            self._announce(aims)

    # ---- what must hold

    def check(self) -> Sequence[LaserReading]:
        """Every laser's own reading, and its photodiode's in the dark; refused where either is not what it should be.

        Asked once a view: a laser that ages or hops is seen by its own reading whatever the gate and the fibre do, and
        a gate that is told shut and lets light through by the photodiode behind it.
        """
        if self.open_gate >= 0:
            raise Refused(f"the lasers are checked in the dark, and the gate of laser {self.open_gate} is open")
        readings = []
        for head, wiring in zip(self.devices().heads, self.wiring, strict=True):
            own_mw = head.require_power(self._power_tolerance)
            counts = self.board().counts(wiring.pin)
            remedy = f"see that the gate of {head.name} shuts, shade the photodiode, or correct its offset"
            require_darkness(counts, wiring.pin, head.name, "with every gate shut", remedy)
            readings.append(LaserReading(1e-3 * wiring.power_mw, 1e-3 * own_mw, counts * wiring.watts_per_count))
        return readings

    @property
    def open_gate(self) -> int:
        """The laser whose gate is open, or -1."""
        board = self._board
        if board is None:
            return -1
        return next((i for i, wiring in enumerate(self.wiring) if board.lit(wiring.gate_line)), -1)

    def require_guards(self) -> None:
        """Refuse an image while nobody would switch a laser off, or after one was: asked at every image."""
        for head in self.devices().heads:
            head.require_guard()

    def require_dark(self, what: str) -> None:
        """Refuse to move anything while laser light is let out."""
        self.devices()
        if self.open_gate >= 0:
            raise Refused(f"the {what} must not move while the gate of laser {self.open_gate} is open")


def warm_up(clock: Clock, seconds: float, heads: Sequence[LaserDriver]) -> None:
    """Wait while lasers that emit become steady, and end at once where the guard of one ends, or the program is to."""
    left = seconds
    while left > 0:
        clock.sleep(min(left, GUARDS_EVERY_S))
        left -= GUARDS_EVERY_S
        raise_if_interrupted()
        for head in heads:
            head.require_guard()


def cut_light(clock: Clock, board: Board, heads: Sequence[LaserDriver]) -> None:
    """Tell gates and lasers to go dark, without waiting for answers; returns when they have heard it."""
    interruptions = _each(clock, [board.shut_now, *(head.off_now for head in heads)])
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
            quiet = error.known or isinstance(error, SwitchedOff)  # its guard was faster, and speaks up if it fails
            log.log(logging.INFO if quiet else logging.ERROR, "making the rig safe: %s", error)
        except Exception as error:  # noqa: BLE001 - the other devices matter more
            log.error("making the rig safe: %s", error)
        except BaseException as error:  # noqa: BLE001 - raised when the other devices are off
            interruptions.append(error)

    side_by_side(clock, [partial(attempt, step) for step in steps])
    return interruptions


def require_darkness(counts: int, pin: int, laser: str, when: str, remedy: str) -> None:
    """Refuse a photodiode's reading that is not dark. laser: whose photodiode; when: why it should be."""
    if counts > DARK_COUNTS:
        problem = f"reads {counts} counts {when} (allowed: {DARK_COUNTS})"
        raise DeviceFault(f"pin {pin}", f"the photodiode of {laser}", problem, remedy)
