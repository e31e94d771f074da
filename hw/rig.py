"""A rig of real devices behind `hw.interface.Rig`: Omicron lasers, an MM-Ard board, a turntable, cameras.

The board moves the mirrors, opens the gates, switches the floodlight and reads the photodiode. Lasers stay powered
through a scan, since emission takes seconds to start: between images they are dark because their gates are shut.
Whatever is emulated or simulated comes in by the port's name, the cameras and the timebase.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self, TypeVar

from hw.clock import Clock, Elapsed, Timebase
from hw.devices.mm_ard import ADC_TOP
from hw.devices.turning import Table
from hw.errors import DeviceFault, NoAnswer, Refused, SwitchedOff
from hw.interface import Aim, Camera, Floodlight, Laser, Photodiode, Projector, Turntable

log = logging.getLogger(__name__)

T = TypeVar("T")

HEARD_S = 0.02  # until what was told without waiting for an answer has been understood
ATTEMPTS = 3
PROMPT_S = 0.15  # answers take a few milliseconds on an idle computer; a repeated question takes 200 or more
SETTLE_S = 0.005  # of the galvos, after the DAC has taken both values


class Head(Protocol):
    """A laser's driver (`hw.devices.omicron.OmicronLaser`, or a guard in front of it)."""

    @property
    def name(self) -> str: ...
    def arm(self, power_mw: float) -> None: ...
    def emit(self) -> None: ...
    def require_guard(self) -> None: ...
    def require_power(self, tolerance: float) -> None: ...
    def off_now(self) -> None: ...
    def force_off(self) -> None: ...
    def close(self) -> None: ...


class Board(Protocol):
    """The driver of mirrors, TTL lines and photodiode (`hw.devices.mm_ard.MirrorBoard`)."""

    def when_lost(self, action: Callable[[], None]) -> None:
        """What to do when an answer was lost, before anything is repeated."""

    def set_mirrors(self, u: int, v: int) -> None: ...
    def set_lines(self, pattern: int) -> None: ...
    def lines(self) -> int: ...
    def shut_now(self) -> None: ...
    def shut(self) -> None: ...
    def counts(self, pin: int) -> int: ...
    def close(self) -> None: ...


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

    heads: Sequence[Head]
    board: Board
    table: Table


class SerialRig:
    """`hw.interface.Rig` over drivers. Devices are connected on entering, so that entering again reconnects."""

    def __init__(
        self,
        connect: Callable[[], Devices],
        wiring: Sequence[LaserWiring],
        cameras: Sequence[Camera],
        clock: Clock,
        *,
        flood_line: int | None = None,
        armed_line: int | None = None,
        warm_up_s: float = 0.0,
        power_tolerance: float = 0.1,
        timebase: Timebase | None = None,
        announce: Callable[[Sequence[Aim]], None] | None = None,
        centre: tuple[int, int] = (2048, 2048),
    ) -> None:
        """`connect` closes what it has opened if it fails. `centre`: where the mirrors stand at first.

        armed_line: a TTL line that is high as long as the rig is on: a warning lamp, and the witness that the board has
        not been reset since (it would have forgotten where the mirrors stand). warm_up_s: from emission to the first
        image; then every laser's own reading must lie within `power_tolerance` of its set point.
        """
        self._connect, self.wiring, self.clock = connect, tuple(wiring), clock
        self.flood_line, self._announce, self._centre = flood_line, announce, centre
        self._armed = 0 if armed_line is None else 1 << armed_line
        self._warm_up_s, self._power_tolerance = warm_up_s, power_tolerance
        self._timebase: Timebase = Elapsed(clock) if timebase is None else timebase
        self._devices: Devices | None = None
        self._pattern, self._last_open = 0, -1
        self._opening = self._cut = False  # a gate is just being opened; the lasers were told off in a hurry
        self._aim, self._aimed = centre, False  # where the mirrors were told to stand; whether that is certain
        self.lasers: Sequence[Laser] = [GatedLaser(self, i) for i in range(len(self.wiring))]
        self.projector: Projector = Mirrors(self)
        self.turntable: Turntable = Turning(self)
        self.cameras: Sequence[Camera] = list(cameras)
        self.photodiode: Photodiode = AdcPhotodiode(self)
        self.floodlight: Floodlight = TtlFloodlight(self)

    # ---- on and off

    def __enter__(self) -> Self:
        """Connect, home, then arm the lasers and wait for their emission, behind shut gates."""
        self._devices = devices = self._connect()
        self._opening = self._cut = False
        devices.board.when_lost(self._lost)
        try:
            devices.board.shut()
            self._pattern = 0
            self.aim(*self._centre)
            devices.table.home()
            for head, wiring in zip(devices.heads, self.wiring, strict=True):
                head.arm(wiring.power_mw)
                head.emit()
            if self._armed:
                devices.board.set_lines(self._armed)
                self._pattern = self._armed
            self.clock.sleep(self._warm_up_s)
            for head in devices.heads:
                head.require_power(self._power_tolerance)
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
        """Gates shut, lasers and floodlight off, ports given back. Never raises; no device's failure stops another's.

        First everybody is told, which takes no time; then each confirms, which a device that has fallen silent can draw
        out for seconds.
        """
        devices, self._devices = self._devices, None
        self._pattern, self._last_open = 0, -1
        if devices is None:
            return
        steps: list[Callable[[], None]] = [devices.board.shut_now]
        steps += [head.off_now for head in devices.heads]
        steps += [lambda: self.clock.sleep(HEARD_S), devices.board.shut]
        steps += [head.force_off for head in devices.heads]
        steps += [head.close for head in devices.heads]
        steps += [devices.board.close, devices.table.close]
        for step in steps:
            try:
                step()
            except SwitchedOff as error:
                log.info("making the rig safe: %s", error)  # its guard was faster, and speaks up if it fails
            except Exception as error:  # noqa: BLE001 - the steps that follow matter more
                log.error("making the rig safe: %s", error)

    def cut(self) -> None:
        """Tell gates and lasers to go dark without waiting for answers; the rig must be entered anew then."""
        if self._devices is None:
            return
        self._cut = True
        for tell in (self._devices.board.shut_now, *(head.off_now for head in self._devices.heads)):
            try:
                tell()
            except Exception as error:  # noqa: BLE001 - the others must be told
                log.error("cutting the light: %s", error)
        self.clock.sleep(HEARD_S)

    def _lost(self) -> None:
        """The board's answer was lost: no light while that is found out, and no opening is repeated."""
        if self._opening:
            self.devices().board.shut_now()
            self.clock.sleep(HEARD_S)
            raise NoAnswer("board", "the mirror board", "did not confirm an open gate", "check its cable")
        if self.open_gate >= 0:
            self.cut()

    @property
    def connected(self) -> bool:
        """Whether the devices are there."""
        return self._devices is not None

    def devices(self) -> Devices:
        """The drivers; refused outside `with rig:`."""
        if self._devices is None:
            raise Refused("the rig is switched off: use it inside `with rig:`")
        return self._devices

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

    # ---- TTL lines

    @property
    def open_gate(self) -> int:
        """The laser whose gate is open, or -1."""
        return next((i for i, w in enumerate(self.wiring) if self._pattern >> w.gate_line & 1), -1)

    def lit(self, line: int) -> bool:
        """Whether a line is switched on."""
        return bool(self._pattern >> line & 1)

    def ask(self, question: Callable[[Board], T]) -> T:
        """Say something to the board. If that had to be repeated, the mirrors are not trusted any more.

        A board that is reset forgets where the mirrors stand, and its armed line falls until lines are set again: a
        reset is seen by that line (`require_lines`), or by an answer that did not come at once.
        """
        begun = self.clock.now()
        answer = question(self.devices().board)
        if self.clock.now() - begun > PROMPT_S:
            log.info("the mirror board was slow to answer: the mirrors will be aimed anew")
            self._aimed = False
        return answer

    def switch(self, line: int, on: bool) -> None:
        """One line, the others as they are. A line that may have been switched counts as on."""
        before = self._pattern
        after = before | 1 << line if on else before & ~(1 << line)
        self._pattern = before | after
        self.ask(lambda board: board.set_lines(after))
        self._pattern = after

    def open_line(self, line: int) -> None:
        """Open a gate, being certain that the mirrors stand where they were told to."""
        if self._cut:
            problem = "lost an answer while a gate was open: the lasers were switched off"
            raise DeviceFault("board", "the mirror board", problem, "check its cable, then repeat the command")
        for _ in range(ATTEMPTS):
            if not self._aimed:
                self.aim(*self._aim)
            self.require_lines()
            if self._try_open(line) and self._aimed:
                return
            self._aimed = False
            self.switch(line, False)
        raise self._slow("open a gate")

    def _try_open(self, line: int) -> bool:
        """Once: where the answer is lost the board may have been reset, its mirrors anywhere, so it is not repeated."""
        self._opening = True
        try:
            self.switch(line, True)
        except NoAnswer as error:
            log.warning("%s; shutting it and aiming anew", error.without_remedy)
            return False
        finally:
            self._opening = False
        return True

    def aim(self, u: int, v: int) -> None:
        """Mirror steps; returns when the mirrors have settled."""
        self._aim = (u, v)
        for _ in range(ATTEMPTS):
            self._aimed = True
            self.ask(lambda board: board.set_mirrors(u, v))
            if self._aimed:
                self.clock.sleep(SETTLE_S)
                return
        raise self._slow("aim its mirrors")

    def _slow(self, what: str) -> DeviceFault:
        problem = f"did not {what} promptly in {ATTEMPTS} attempts"
        return DeviceFault("board", "the mirror board", problem, "check its cable and power supply")

    def require_lines(self) -> None:
        """Refuse an image during which the board was reset: gates and mirrors have moved."""
        found = self.ask(lambda board: board.lines())
        if found != self._pattern:
            problem = f"has its TTL lines at {found:06b} instead of {self._pattern:06b}: it was reset"
            raise DeviceFault("board", "the mirror board", problem, "check its power supply, then repeat the command")

    def require_guards(self) -> None:
        """Refuse an image while nobody would switch a laser off, or after one was: asked at every image."""
        for head in self.devices().heads:
            head.require_guard()

    def require_dark(self, what: str) -> None:
        """Refuse to move anything while laser light is let out."""
        self.devices()
        if self.open_gate >= 0:
            raise Refused(f"the {what} must not move while the gate of laser {self.open_gate} is open")

    @property
    def last_open(self) -> int:
        """The laser whose gate was opened last, or -1."""
        return self._last_open

    def opened(self, laser: int) -> None:
        """Remember whose photodiode is to be read."""
        self._last_open = laser


@dataclass
class GatedLaser:
    """One laser behind its gate."""

    rig: SerialRig
    index: int

    @property
    def wavelength_nm(self) -> float:
        """Nominal wavelength."""
        return self.rig.wiring[self.index].wavelength_nm

    def open_gate(self) -> None:
        """Let light out; refused while another gate is open."""
        self.rig.require_guards()
        if self.rig.open_gate not in (-1, self.index):
            raise Refused(f"the gate of laser {self.rig.open_gate} is open: one laser at a time")
        self.rig.opened(self.index)
        self.rig.open_line(self.rig.wiring[self.index].gate_line)

    def close_gate(self) -> None:
        """Shut this gate; always allowed."""
        if self.rig.open_gate == self.index:
            self.rig.switch(self.rig.wiring[self.index].gate_line, False)

    def darken(self) -> None:
        """Every gate and laser is told off; closing the gate then confirms."""
        self.rig.cut()


@dataclass
class Mirrors:
    """The two mirrors."""

    rig: SerialRig

    def move(self, u: int, v: int) -> None:
        """Aim at mirror steps (u, v); returns when the mirrors have settled."""
        self.rig.require_dark("projector")
        self.rig.aim(u, v)


@dataclass
class Turning:
    """The turntable."""

    rig: SerialRig

    def move(self, angle_rad: float) -> None:
        """Turn to an angle; returns when the table stands still."""
        self.rig.require_dark("turntable")
        self.rig.devices().table.move(angle_rad)


@dataclass
class AdcPhotodiode:
    """The photodiode of the laser that was opened last, by the board's 10-bit converter."""

    rig: SerialRig

    def read(self) -> float:
        """Watts on the object; refused when they are not those that the laser was set to."""
        self.rig.require_guards()
        laser = self.rig.last_open
        if laser < 0:
            return 0.0
        self.rig.require_lines()
        wiring = self.rig.wiring[laser]
        counts = self.rig.ask(lambda board: board.counts(wiring.pin))
        watts = counts * wiring.watts_per_count
        low, high = wiring.limits
        if self.rig.open_gate == laser and (counts >= ADC_TOP or not low <= watts / (wiring.power_mw * 1e-3) <= high):
            head = self.rig.devices().heads[laser]
            problem = f"gives {1e3 * watts:.2f} mW at the photodiode instead of {wiring.power_mw:g} mW"
            if counts >= ADC_TOP:
                problem += " (the converter is at its top)"
            remedy = "check the laser's interlock, the gate and the photodiode's gain"
            raise DeviceFault(f"pin {wiring.pin}", head.name, problem, remedy)
        return watts


@dataclass
class TtlFloodlight:
    """The spotlights that fully illuminate the object for a silhouette image, on a TTL line of the board."""

    rig: SerialRig

    def on(self) -> None:
        """Switch on."""
        self.rig.devices()
        if self.rig.flood_line is None:
            raise Refused("this rig has no floodlight: name its TTL line in the rig file")
        self.rig.switch(self.rig.flood_line, True)

    def off(self) -> None:
        """Switch off; always allowed. Refuses the image if the light had gone out before."""
        line = self.rig.flood_line
        if line is None or not self.rig.connected:
            return
        try:
            if self.rig.lit(line):
                self.rig.require_lines()
        finally:
            self.rig.switch(line, False)
