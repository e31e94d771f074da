"""From a rig file to drivers: every device on its port, or on the port of what stands in for it, and the cameras.

Emulated ports, simulated cameras and the sizes of real ones are handed in. A script that needs no light, and so no
`hw.rig.serial_rig.SerialRig`, uses a `Connector` alone (docs/lab.md, section 7).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from hw.base.clock import Clock, Timebase, WallClock
from hw.base.errors import DeviceError, DeviceFault, InputError
from hw.devices import elliptec, mm_ard, ophir, zaber
from hw.devices.omicron import OFF_SHARE, OmicronLaser
from hw.devices.turning import TurntableDriver
from hw.interface import Aim, Camera
from hw.rig.drivers import Board, Drivers, close_all
from hw.rig.limits import LimitedBoard, PlacedTable, Subscriber
from hw.rig.rig_file import EMULATED, DevicesFile, GenicamDevice, SensorDevice, ZaberDevice
from hw.safety.ports.protocol_supervised import PREFIX, port_of
from hw.safety.signals import uninterrupted
from hw.serial.bytelog import ByteLog
from hw.serial.link import Link

if TYPE_CHECKING:
    from hw.camera.genicam import GenicamCamera

log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True)
class StandIns:
    """What stands in for devices that are not there: nothing, unless it is named.

    ports: the URL of every emulated device by its name (laser0 .., board, turntable); cameras: the simulated ones;
    timebase, announce: of the record and of the capture's plans, with simulated cameras; subscriber: follows what
    real devices do.
    """

    clock: Clock = field(default_factory=WallClock)
    ports: Mapping[str, str] = field(default_factory=dict)
    cameras: Sequence[Camera] = ()
    timebase: Timebase | None = None
    announce: Callable[[Sequence[Aim]], None] = lambda aims: None
    subscriber: Subscriber = field(default_factory=Subscriber)


class Connector:
    """Opens what a rig file names. logs: the folder of the byte logs, one a device."""

    def __init__(self, file: DevicesFile, stand_ins: StandIns | None = None, logs: Path | None = None) -> None:
        self.file, self.stand_ins, self.logs = file, stand_ins or StandIns(), logs
        self.clock = self.stand_ins.clock

    def _opened(
        self, key: str, baud: int, device: str, name: str, driver: Callable[[Link], T], supervised: str = ""
    ) -> T:
        """A driver on the link to its port, which is closed if the driver refuses the device.

        key: of the port in the rig file; name: of the device among the stand-ins, and of its byte log; supervised: the
        kind of a device that the supervisor makes dark
        """
        port = self.file.ports()[key]
        url = f"{PREFIX}{supervised}:{port}" if supervised else port
        if port == EMULATED:
            url = self.stand_ins.ports.get(name, "")
        if not url:
            remedy = "name the device's port, or hand in what stands in for it"
            raise InputError("nothing emulates this device here", file=self.file.path, key=key, value=port,
                             remedy=remedy)  # fmt: skip
        record = None if self.logs is None else ByteLog(self.logs / f"{name}.log")
        with keys_named(self.file):
            try:
                link = Link(url, baud, device, self.clock, record)
            except BaseException:
                if record is not None:
                    record.close()
                raise
            try:
                return driver(link)
            except BaseException:
                link.close()
                raise

    def _subscriber(self, port: str) -> Subscriber:
        """Emulated devices move the simulation by themselves; it follows the real ones."""
        return Subscriber() if port == EMULATED else self.stand_ins.subscriber

    def omicron(self, index: int) -> OmicronLaser:
        """A laser's driver; connecting switches it off. Closed again if its power cannot be set.

        Raises: DeviceError, InputError.
        """
        laser = self._dark(index)
        try:
            self._require_settable(index, laser)
        except BaseException:
            laser.close()
            raise
        return laser

    def _dark(self, index: int) -> OmicronLaser:
        """A laser that is switched off, whatever power the rig file names."""
        device = self.file.lasers[index]
        followed = partial(self._subscriber(device.port).laser, index)
        return self._opened(
            f"lasers[{index}].port",
            device.baud,
            device.title,
            f"laser{index}",
            lambda link: OmicronLaser(link, device.wavelength_nm, followed),
            supervised="laser",
        )

    def _require_settable(self, index: int, laser: OmicronLaser) -> None:
        """Refuse a power that this laser cannot be set to: one in watts or microwatts, or another laser's."""
        top, power_mw = laser.identity.max_power_mw, self.file.lasers[index].power_mw
        if OFF_SHARE * top < power_mw <= top * (1.0 + 1e-9):
            return
        problem = f"{laser.name} ({laser.identity.model}) reports that its maximum is {top:g} mW"
        remedy = "give the power in mW"
        if power_mw < top:
            problem += f", and takes {100 * OFF_SHARE:g} % of it for darkness"
            remedy += f" ({1e3 * power_mw:g}, if this is in W)" if 1e3 * power_mw <= top else ""
        allowed = f"more than {OFF_SHARE * top:g}, at most {top:g}"
        raise InputError(problem, file=self.file.path, key=f"lasers[{index}].power_mw", value=power_mw,
                         allowed=allowed, remedy=remedy)  # fmt: skip

    def meter(self) -> ophir.OphirMeter:
        """The power meter's driver. Raises: InputError without [power_meter]."""
        if self.file.power_meter is None:
            remedy = "add the table [power_meter]"
            raise InputError("the rig file has no power meter", file=self.file.path, key="power_meter", remedy=remedy)
        return self._opened("power_meter.port", ophir.BAUD, "power meter", "power_meter", ophir.OphirMeter)

    def board(self) -> LimitedBoard:
        """The board's driver, which keeps the mirrors within their limits; connecting shuts every line."""
        device = self.file.board
        limits, subscriber = (device.limits_u, device.limits_v), self._subscriber(device.port)
        driver = partial(LimitedBoard, limits=limits, subscriber=subscriber)
        return self._opened("board.port", mm_ard.BAUD, "mirror board", "board", driver, "board")

    def table(self) -> TurntableDriver:
        """The turntable's driver, in angles of the rig."""
        device = self.file.turntable
        baud = zaber.BAUD if isinstance(device, ZaberDevice) else elliptec.BAUD

        def driver(link: Link) -> TurntableDriver:
            if isinstance(device, ZaberDevice):
                return zaber.ZaberTable(link, device.microsteps_per_deg, device.reach_s, device.device, device.axis)
            return elliptec.ElliptecTable(link, device.address, device.reach_s)

        table = self._opened("turntable.port", baud, "turntable", "turntable", driver)
        zero_rad, subscriber = float(np.deg2rad(device.zero_deg)), self._subscriber(device.port)
        return PlacedTable(table, zero_rad, device.direction, subscriber)

    def connect(self) -> Drivers:
        """All of them, or none. Whatever fails, what an earlier program left lit is told to go dark first.

        The board shuts gates and lamps, then every laser is switched off in being connected, whatever the others
        report; nothing is refused, and Ctrl-C has no effect, before that.

        Raises: DeviceError, or InputError where the rig file does not fit the devices.
        """
        boards: list[Board] = []
        lasers: list[OmicronLaser] = []
        failed: list[Exception] = []

        def attempt(step: Callable[[], T], into: list[T]) -> None:
            try:
                into.append(step())
            except Exception as error:  # noqa: BLE001 - also one that nobody foresaw: raised when everything is dark
                failed.append(error)

        try:
            with uninterrupted():
                attempt(self.board, boards)
                for index in range(len(self.file.lasers)):
                    attempt(partial(self._dark, index), lasers)
            for error in failed[1:]:
                log.error("%s", error)
            if failed:
                raise failed[0]
            for index, laser in enumerate(lasers):
                self._require_settable(index, laser)
            return Drivers(lasers, boards[0], self.table(), self.clock)
        except BaseException:
            close_all(self.clock, [*boards, *lasers])
            raise

    @contextmanager
    def connected(self) -> Iterator[Drivers]:
        """The drivers of everything, dark and closed at the end."""
        with keys_named(self.file):
            drivers = self.connect()
            try:
                yield drivers
            finally:
                drivers.close()


# ---- cameras


def open_camera(file: DevicesFile, device: GenicamDevice, shape: tuple[int, int]) -> GenicamCamera:
    """A GenICam camera of the rig file that makes the bracket's exposures. shape: (height, width).

    Raises: CameraError, InputError.
    """
    from hw.camera.genicam import CameraError, GenicamCamera
    from hw.camera.viva_grabber import VivaGrabber

    table = f"cameras[{file.cameras.index(device)}]"
    if file.sensor is None or not isinstance(device, GenicamDevice):  # the rig file's own check: no sensor, no camera
        raise InputError("is simulated, and none can be opened", file=file.path, key=table,
                         remedy="name a GenICam camera, and its [sensor]")  # fmt: skip
    try:
        grabber = VivaGrabber(device.address, device.pixel_format, shape, serial=device.serial)
        camera = GenicamCamera(device.name, grabber, file.sensor.bracket(), shape)
        try:
            camera.check()
        except BaseException:
            camera.close()
            raise
    except CameraError as error:
        raise CameraError(f"{file.path}: {table}.address = {device.address!r}: {error}") from error
    except InputError as error:
        key = error.key if error.key is None or "." in error.key else f"{table}.{error.key}"
        raise error.amended(file=file.path, key=key) from error
    return camera


def require_black(camera: GenicamCamera, sensor: SensorDevice) -> float:
    """Measure the black level in the dark rig.

    Raises: DeviceFault where it is not the rig file's, in which tails of R_d would drown.
    """
    mean, _ = camera.black_level()
    if not abs(mean - sensor.black_dn) <= sensor.black_tolerance_dn:
        problem = (
            f"shows {mean:.1f} in the dark instead of {sensor.black_dn:g} (allowed: {sensor.black_tolerance_dn:g} off)"
        )
        remedy = "cover the rig; if it is dark, correct sensor.black_dn in the rig file"
        raise DeviceFault(camera.grabber.identity(), f"camera {camera.name}", problem, remedy)
    return mean


# ---- errors


@contextmanager
def keys_named(file: DevicesFile) -> Iterator[None]:
    """Errors of devices that leave this block name the rig file and the key of the device's port.

    Drivers have their port alone, and the rig calls its board `board`.
    """
    ports = {port: key for key, port in file.ports().items() if port != EMULATED}
    try:
        yield
    except DeviceError as error:
        port = file.board.port if error.port == "board" else port_of(error.port)
        if error.key is not None or port not in ports:
            raise
        raise error.set_by(ports[port], port, file.path) from error.__cause__
