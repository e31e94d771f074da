"""From a rig file to a rig: real devices on their ports, emulated ones on memory ports, cameras real or simulated.

Emulated devices move the twin by themselves. What a real device does is told to the twin where cameras are simulated
(`disco_twin.emulation.mirrored_devices`), so that they see it: a real turntable turns the simulated object.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from disco_twin.emulation.mirrored_devices import LimitedBoard, MirroredBoard, MirroredLaser, PlacedTable, turn_twin
from disco_twin.emulation.rig_file import EMULATED, DevicesFile, GenicamDevice, LaserDevice, SensorDevice, ZaberDevice
from hw.base.clock import Clock, VirtualClock, WallClock
from hw.base.errors import DeviceError, DeviceFault, InputError
from hw.devices.elliptec import BAUD as ELLIPTEC_BAUD
from hw.devices.elliptec import ElliptecTable
from hw.devices.mm_ard import BAUD as BOARD_BAUD
from hw.devices.mm_ard import LINES, MirrorBoard
from hw.devices.omicron import OFF_SHARE, OmicronLaser
from hw.devices.ophir import BAUD as OPHIR_BAUD
from hw.devices.ophir import OphirMeter
from hw.devices.turning import Table
from hw.devices.zaber import BAUD as ZABER_BAUD
from hw.devices.zaber import ZaberTable
from hw.interface import Camera
from hw.rig.serial_rig import SerialRig, close_all
from hw.rig.wiring import Board, Devices, LaserDriver, LaserWiring
from hw.safety.ports.protocol_guard import PREFIX
from hw.safety.signals import uninterrupted
from hw.serial.bytelog import ByteLog
from hw.serial.link import Link
from pipeline.geometry.nominal_rig import RigConfig

if TYPE_CHECKING:
    from disco_twin.emulation.emulated_rig import Emulation
    from disco_twin.emulation.twin_rig import TwinRig
    from hw.camera.genicam import GenicamCamera

T = TypeVar("T")


class Connector:
    """Opens what a rig file names. `emulation` has the devices that are emulated, and the twin that real ones move."""

    def __init__(self, file: DevicesFile, clock: Clock, emulation: Emulation | None, logs: Path | None) -> None:
        self.file, self.clock, self.emulation, self.logs = file, clock, emulation, logs
        self._follow = file.simulated_cameras
        self._urls = {} if emulation is None else emulation.attach()

    def _opened(
        self, key: str, baud: int, device: str, name: str, driver: Callable[[Link], T], guarded: bool = False
    ) -> T:
        """A driver on the link to its port, which is closed if the driver refuses the device.

        key: of the port in the rig file; name: of the device's emulated line and of its byte log
        """
        port = self.file.ports()[key]
        url = self._urls[name] if port == EMULATED else f"{PREFIX}{port}" if guarded else port
        try:
            link = Link(
                url, baud, device, self.clock, None if self.logs is None else ByteLog(self.logs / f"{name}.log")
            )
            try:
                return driver(link)
            except BaseException:
                link.close()
                raise
        except DeviceError as error:
            if port == EMULATED:
                raise
            named = error.set_by(key, port)
            raise (named if self.file.path is None else named.within(self.file.path)) from error.__cause__

    def omicron(self, index: int) -> OmicronLaser:
        """A laser's driver; connecting switches it off. Closed again if its power cannot be set."""
        head = self._dark(index)
        try:
            self._require_settable(index, head)
        except BaseException:
            head.close()
            raise
        return head

    def _dark(self, index: int) -> OmicronLaser:
        """A laser that is switched off, whatever power the rig file names."""
        device = self.file.lasers[index]
        name = f"laser {device.wavelength_nm:g} nm"
        return self._opened(
            f"lasers[{index}].port",
            device.baud,
            name,
            f"laser{index}",
            lambda link: OmicronLaser(link, device.wavelength_nm),
            guarded=True,
        )

    def _require_settable(self, index: int, head: OmicronLaser) -> None:
        """Refuse a power that this laser cannot be set to: one in watts or microwatts, or another laser's."""
        top, power_mw = head.identity.max_power_mw, self.file.lasers[index].power_mw
        if OFF_SHARE * top < power_mw <= top * (1.0 + 1e-9):
            return
        problem = f"{head.name} ({head.identity.model}) says that its maximum is {top:g} mW"
        remedy = "give the power in mW"
        if power_mw < top:
            problem += f", and takes {100 * OFF_SHARE:g} % of it for darkness"
            remedy += f" ({1e3 * power_mw:g}, if this is in W)" if 1e3 * power_mw <= top else ""
        raise InputError(
            problem,
            file=self.file.path,
            key=f"lasers[{index}].power_mw",
            value=power_mw,
            allowed=f"more than {OFF_SHARE * top:g}, at most {top:g}",
            remedy=remedy,
        )

    def meter(self) -> OphirMeter:
        """The power meter's driver."""
        if self.file.power_meter is None:
            remedy = "add the table [power_meter]"
            raise InputError("the rig file has no power meter", file=self.file.path, key="power_meter", remedy=remedy)
        return self._opened("power_meter.port", OPHIR_BAUD, "power meter", "power_meter", OphirMeter)

    def _followed(self, index: int, head: OmicronLaser) -> LaserDriver:
        """A laser as the rig uses it."""
        if self.file.lasers[index].port == EMULATED or not self._follow or self.emulation is None:
            return head
        return MirroredLaser(head, self.emulation.bench, index)

    def board(self) -> Board:
        """The board's driver; connecting shuts every line."""
        device = self.file.board
        board = self._opened("board.port", BOARD_BAUD, "mirror board", "board", MirrorBoard)
        limits = (device.limits_u, device.limits_v)
        if device.port == EMULATED or not self._follow or self.emulation is None:
            return LimitedBoard(board, limits)
        return MirroredBoard(board, limits, self.emulation.bench)

    def table(self) -> Table:
        """The turntable's driver."""
        device = self.file.turntable
        baud = ZABER_BAUD if isinstance(device, ZaberDevice) else ELLIPTEC_BAUD

        def driver(link: Link) -> Table:
            if isinstance(device, ZaberDevice):
                return ZaberTable(link, device.microsteps_per_deg, device.reach_s, device.device, device.axis)
            return ElliptecTable(link, device.address, device.reach_s)

        table = self._opened("turntable.port", baud, "turntable", "turntable", driver)
        follow = device.port != EMULATED and self._follow and self.emulation is not None
        told = turn_twin(self.emulation.bench) if follow and self.emulation is not None else _nobody
        return PlacedTable(table, float(np.deg2rad(device.zero_deg)), device.direction, told)

    def connect(self) -> Devices:
        """All of them, or none. Whatever fails, what an earlier program left lit is told to go dark first.

        The board shuts gates and lamps, then every laser is switched off in being connected, whatever the others say;
        nothing is refused, and no Ctrl-C heard, before that.
        """
        boards: list[Board] = []
        heads: list[OmicronLaser] = []
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
                    attempt(partial(self._dark, index), heads)
            for error in failed:
                raise error
            for index, head in enumerate(heads):
                self._require_settable(index, head)
            table = self.table()
        except BaseException:
            close_all(self.clock, [*boards, *heads])
            raise
        return Devices([self._followed(index, head) for index, head in enumerate(heads)], boards[0], table)


def _nobody(angle_deg: float) -> None:
    """No simulated camera looks."""


def wiring_of(laser: LaserDevice) -> LaserWiring:
    """The rig file's words in the rig's."""
    return LaserWiring(
        laser.wavelength_nm,
        laser.power_mw,
        laser.gate_line,
        laser.photodiode_pin,
        laser.watts_per_count,
        laser.photodiode_limits,
    )


def open_camera(file: DevicesFile, device: GenicamDevice, shape: tuple[int, int]) -> GenicamCamera:
    """A GenICam camera of the rig file that makes the bracket's exposures. shape: (height, width)."""
    from hw.camera.genicam import CameraError, GenicamCamera
    from hw.camera.viva_grabber import VivaGrabber

    assert file.sensor is not None  # the rig file's own check
    table = f"cameras[{file.cameras.index(device)}]"
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
        raise InputError(error.problem, file=file.path, key=key, value=error.value, allowed=error.allowed,
                         remedy=error.remedy) from error  # fmt: skip
    return camera


def require_black(camera: GenicamCamera, sensor: SensorDevice) -> float:
    """Measure the black level in the dark rig; refuse one that is not the rig file's: tails of R_d drown in it."""
    mean, _ = camera.black_level()
    if not abs(mean - sensor.black_dn) <= sensor.black_tolerance_dn:
        problem = (
            f"shows {mean:.1f} in the dark instead of {sensor.black_dn:g} (allowed: {sensor.black_tolerance_dn:g} off)"
        )
        remedy = "cover the rig; if it is dark, correct sensor.black_dn in the rig file"
        raise DeviceFault(camera.grabber.identity(), f"camera {camera.name}", problem, remedy)
    return mean


@contextmanager
def keys_named(file: DevicesFile) -> Iterator[None]:
    """Errors of devices that leave this block name the rig file and the key of the device's port.

    Drivers know their port alone, and the rig calls its board `board`.
    """
    ports = {port: key for key, port in file.ports().items() if port != EMULATED}
    try:
        yield
    except DeviceError as error:
        port = file.board.port if error.port == "board" else error.port.removeprefix(PREFIX)
        if error.key is not None or port not in ports:
            raise
        named = error.set_by(ports[port], port)
        raise (named if file.path is None else named.within(file.path)) from error.__cause__


@contextmanager
def assembled(
    file: DevicesFile, scene: RigConfig, twin: TwinRig | None = None, logs: Path | None = None, *, armed: bool
) -> Iterator[SerialRig]:
    """The rig, its cameras open. `twin`: where something is emulated or simulated; its cameras are used or not.

    armed: real lasers may emit. Emulated ones need no permission.
    """
    from disco_twin.emulation.emulated_rig import Emulation

    clock: Clock = VirtualClock() if file.all_emulated and file.simulated_cameras else WallClock()
    emulation = None if twin is None else Emulation(twin, clock)
    if emulation is None and (file.simulated_cameras or EMULATED in file.ports().values()):
        raise InputError("emulated devices and simulated cameras need a twin")
    with keys_named(file), ExitStack() as opened:
        cameras: list[Camera] = []
        black: list[Callable[[], float]] = []
        if emulation is not None and file.simulated_cameras:
            cameras = list(emulation.bench.cameras)
        else:
            for device, nominal in zip(file.cameras, scene.cameras, strict=True):
                assert isinstance(device, GenicamDevice) and file.sensor is not None  # the rig file's own check
                camera = open_camera(file, device, (nominal.height, nominal.width))
                opened.callback(camera.close)
                black.append(partial(require_black, camera, file.sensor))
                cameras.append(camera)
        yield SerialRig(
            Connector(file, clock, emulation, logs).connect,
            [wiring_of(laser) for laser in file.lasers],
            cameras,
            clock,
            armed=armed or not file.real_lasers,
            flood_line=file.board.floodlight_line,
            armed_line=free_line(file),
            warm_up_s=file.warm_up_s,
            power_tolerance=file.power_tolerance,
            timebase=emulation.bench if emulation is not None and file.simulated_cameras else None,
            announce=twin.announce if twin is not None and file.simulated_cameras else None,
            centre=file.board.centre,
            in_the_dark=lambda: [measure() for measure in black],
        )


def free_line(file: DevicesFile) -> int:
    """The highest TTL line that nothing else uses: it is high while the rig is on (at most four others are used)."""
    used = {laser.gate_line for laser in file.lasers} | {file.board.floodlight_line}
    return max(line for line in range(LINES) if line not in used)
