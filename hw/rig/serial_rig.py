"""A rig of real devices behind `hw.interface.Rig`: Omicron lasers, an MM-Ard board, a turntable, cameras.

The board moves the mirrors, opens the gates, switches the floodlight and reads the photodiode. Lasers stay powered
through a scan, since emission takes seconds to start: between images they are dark because their gates are shut.
Whatever is emulated or simulated is handed in (`hw.rig.connect.StandIns`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Self, TypeVar

from hw.base.clock import Elapsed, Timebase
from hw.base.errors import InputError, Refused
from hw.interface import Aim, Camera, LaserReading, Rig
from hw.rig.connect import Connector, StandIns, keys_named, open_camera, require_black
from hw.rig.drivers import Drivers
from hw.rig.emission import begin_emission, check_lasers, require_light
from hw.rig.rig_file import DevicesFile, GenicamDevice
from hw.rig.verified_board import VerifiedBoard
from hw.safety.ports.protocol_supervised import require_supervisor
from hw.safety.signals import uninterrupted

T = TypeVar("T")


class SerialRig(Rig):
    """`hw.interface.Rig` over drivers. Devices are connected on entering, so that entering again reconnects."""

    def __init__(
        self,
        connector: Connector,
        cameras: Sequence[Camera],
        *,
        armed: bool,
        in_the_dark: Callable[[], object] = lambda: None,
    ) -> None:
        """armed: lasers may emit; without it the rig refuses to be entered, before anything is connected.

        in_the_dark: what is to be measured, and may be refused, while lasers and lamps are off and the gates shut
        """
        self.file, self.clock, self._armed, self._in_the_dark = connector.file, connector.clock, armed, in_the_dark
        self._connector, stand_ins = connector, connector.stand_ins
        self._timebase: Timebase = Elapsed(self.clock) if stand_ins.timebase is None else stand_ins.timebase
        self._drivers: Drivers | None = None
        self._board: VerifiedBoard | None = None
        self.last_open = -1  # the laser whose gate was opened last: whose photodiode is to be read
        self.lasers = [GatedLaser(self, i, laser.wavelength_nm) for i, laser in enumerate(self.file.lasers)]
        self.projector = Mirrors(self)
        self.turntable = SafeTurntable(self)
        self.cameras = list(cameras)
        self.photodiode = AdcPhotodiode(self)
        self.floodlight = TtlFloodlight(self)

    # ---- on and off

    def __enter__(self) -> Self:
        """Connect, home, light the warning lamp, then arm the lasers and wait for their emission, behind shut gates.

        Raises: Refused unless armed; whatever a device reports, everything being off and closed again then.
        """
        if not self._armed:
            raise Refused(
                "the rig is not armed, and its lasers would emit. Remedy: see to interlock, door and goggles, then arm "
                "it (--arm; in Python armed=True)"
            )
        self._drivers = drivers = self._connector.connect()
        try:
            gates = [laser.gate_line for laser in self.file.lasers]
            self._board = board = VerifiedBoard(drivers.board, self.clock, gates, self.darken)
            self._in_the_dark()
            board.aim(*self.file.board.centre)
            drivers.table.home()
            begin_emission(self.clock, self.file, board, dict(enumerate(drivers.lasers)))
        except BaseException:
            self.make_safe()
            raise
        self._timebase.restart()
        return self

    def make_safe(self) -> None:
        """Gates shut, lasers and lamps off, ports given back. No device's failure stops another's, or is raised.

        First gates and lasers are told; then each device confirms in being closed, which one that has fallen silent can
        draw out for seconds. Ctrl-C waits until all that is done.
        """
        with uninterrupted():
            drivers, self._drivers, self._board, self.last_open = self._drivers, None, None, -1
            if drivers is None:
                return
            try:
                drivers.darken()
            finally:
                drivers.close()

    def darken(self) -> None:
        """Tell gates and lasers to go dark without waiting for answers; the rig must be entered anew then."""
        if self._drivers is None:
            return
        if self._board is not None:
            self._board.distrusted = True
        self._drivers.darken()

    @property
    def connected(self) -> bool:
        """Whether the devices are there."""
        return self._drivers is not None

    def drivers(self) -> Drivers:
        """The drivers. Raises: Refused outside `with rig:`."""
        return _in_use(self._drivers)

    def board(self) -> VerifiedBoard:
        """The board. Raises: Refused outside `with rig:`."""
        return _in_use(self._board)

    # ---- time

    def now(self) -> float:
        """Seconds since the rig was ready."""
        return self._timebase.now()

    def resume_at(self, time_s: float) -> None:
        """Continue an interrupted capture whose last image was stored at `time_s`."""
        self._timebase.resume_at(time_s)

    def announce(self, aims: Sequence[Aim]) -> None:
        """Simulated cameras work ahead; real ones ignore it."""
        self._connector.stand_ins.announce(aims)

    # ---- what must hold

    def check(self) -> Sequence[LaserReading]:
        """Every laser's own reading, and its photodiode's in the dark; refused where either is not what it should be.

        Asked once a view: a laser that ages or hops is seen by its own reading whatever the gate and the fibre do, and
        a gate that is told shut and lets light through by the photodiode behind it.

        Raises: DeviceFault; Refused while a gate is open.
        """
        if self.open_gate >= 0:
            raise Refused(
                f"the lasers are checked in the dark, and the gate of laser {self.open_gate} is open. Remedy: shut it "
                "first"
            )
        return check_lasers(self.file, self.board(), dict(enumerate(self.drivers().lasers)))

    @property
    def open_gate(self) -> int:
        """The laser whose gate is open, or -1."""
        board = self._board
        if board is None:
            return -1
        return next((i for i, laser in enumerate(self.file.lasers) if board.lit(laser.gate_line)), -1)

    def require_dark(self, what: str) -> None:
        """Refuse to move anything while laser light is let out. Raises: Refused."""
        self.drivers()
        if self.open_gate >= 0:
            raise Refused(
                f"the {what} must not move while the gate of laser {self.open_gate} is open. Remedy: shut it first"
            )


def _in_use(device: T | None) -> T:
    if device is None:
        raise Refused("the rig is switched off. Remedy: use it inside `with rig:`")
    return device


# ---- its parts, as `hw.interface` names them


@dataclass
class GatedLaser:
    """One laser behind its gate."""

    rig: SerialRig
    index: int
    wavelength_nm: float

    def open_gate(self) -> None:
        """Let light out; refused while another gate is open. Raises: Refused, DeviceError."""
        require_supervisor()
        if self.rig.open_gate not in (-1, self.index):
            raise Refused(f"the gate of laser {self.rig.open_gate} is open: one laser at a time. Remedy: shut it first")
        self.rig.last_open = self.index
        self.rig.board().open_gate(self.rig.file.lasers[self.index].gate_line)

    def close_gate(self) -> None:
        """Shut this gate; always allowed."""
        if self.rig.open_gate == self.index:
            self.rig.board().switch(self.rig.file.lasers[self.index].gate_line, False)

    def darken(self) -> None:
        """Every gate and laser is told to go dark; closing the gate then confirms."""
        self.rig.darken()


@dataclass
class Mirrors:
    """The two mirrors."""

    rig: SerialRig

    def move(self, u: int, v: int) -> None:
        """Aim at mirror steps (u, v); returns when the mirrors have settled."""
        self.rig.require_dark("projector")
        self.rig.board().aim(u, v)


@dataclass
class SafeTurntable:
    """The turntable, which stands still while a gate is open."""

    rig: SerialRig

    def move(self, angle_rad: float) -> None:
        """Turn to an angle; returns when the table stands still."""
        self.rig.require_dark("turntable")
        self.rig.drivers().table.move(angle_rad)


@dataclass
class AdcPhotodiode:
    """The photodiode of the laser that was opened last, by the board's 10-bit converter."""

    rig: SerialRig

    def read(self) -> float:
        """Watts on the object; refused when they are not those that the laser was set to."""
        require_supervisor()
        laser, board = self.rig.last_open, self.rig.board()
        if laser < 0:
            return 0.0
        board.require_lines()
        device = self.rig.file.lasers[laser]
        counts = board.counts(device.photodiode_pin)
        if self.rig.open_gate == laser:
            return require_light(counts, device)
        return counts * device.watts_per_count


@dataclass
class TtlFloodlight:
    """The spotlights that fully illuminate the object for a silhouette image, on a TTL line of the board."""

    rig: SerialRig

    def on(self) -> None:
        """Switch on."""
        self.rig.board().switch(self.rig.file.board.floodlight_line, True)

    def off(self) -> None:
        """Switch off; always allowed. Refuses the image if the light had gone out before."""
        if not self.rig.connected:
            return
        board, line = self.rig.board(), self.rig.file.board.floodlight_line
        try:
            if board.lit(line):
                board.require_lines()
        finally:
            board.switch(line, False)


@contextmanager
def open_rig(
    file: DevicesFile,
    shapes: Mapping[str, tuple[int, int]],
    stand_ins: StandIns | None = None,
    logs: Path | None = None,
    *,
    armed: bool,
) -> Iterator[SerialRig]:
    """The rig of a file, its cameras open; entering it connects the rest.

    shapes: (height, width) of every GenICam camera, by its name; logs: the folder of the byte logs; armed: real lasers
    may emit, emulated ones need no permission

    Raises: InputError where a simulated camera is not handed in; CameraError.
    """
    connector = Connector(file, stand_ins, logs)
    with keys_named(file), ExitStack() as opened:
        cameras: list[Camera] = []
        black: list[Callable[[], float]] = []
        for device in file.cameras:
            if isinstance(device, GenicamDevice):
                assert file.sensor is not None  # the rig file's own check
                if device.name not in shapes:
                    raise InputError(f"camera {device.name} needs its size", remedy="hand in (height, width)")
                camera = open_camera(file, device, shapes[device.name])
                opened.callback(camera.close)
                black.append(partial(require_black, camera, file.sensor))
                cameras.append(camera)
        if file.simulated_cameras:
            cameras = list(connector.stand_ins.cameras)
            if not cameras:
                problem, remedy = "are simulated, and none are handed in", "name GenICam cameras"
                raise InputError(problem, file=file.path, key="cameras", remedy=remedy)
        yield SerialRig(
            connector,
            cameras,
            armed=armed or not file.real_lasers,
            in_the_dark=lambda: [measure() for measure in black],
        )
