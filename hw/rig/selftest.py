"""`disco-twin rig probe | selftest`: which devices are on the ports, and whether they work."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from hw.base.clock import Clock
from hw.base.errors import DeviceFault, DiscoError, InputError
from hw.devices.omicron import OmicronLaser
from hw.devices.ophir import OphirMeter
from hw.devices.turning import TurntableDriver
from hw.rig.connect import Connector, open_camera, require_black
from hw.rig.drivers import Board, Closable, close_all, darken
from hw.rig.emission import begin_emission, require_darkness, require_light
from hw.rig.rig_file import EMULATED, DevicesFile, GenicamDevice, LaserDevice
from hw.rig.verified_board import VerifiedBoard
from hw.safety.ports.protocol_supervised import require_supervisor

if TYPE_CHECKING:
    from hw.camera.genicam import GenicamCamera

log = logging.getLogger(__name__)

Shapes = Mapping[str, tuple[int, int]]

TEST_ANGLE_DEG = 30.0
ANGLE_TOLERANCE_DEG = 0.05
TABLE_KEY = {"zaber": "microsteps_per_deg", "elliptec": "address"}  # what a wrong angle comes of
FRAMES = 20


@dataclass(frozen=True)
class DeviceFinding:
    """One line of a probe or self-test."""

    name: str
    good: bool
    text: str

    def __str__(self) -> str:
        return f"{'ok  ' if self.good else 'FAIL'}  {self.name:<22} {self.text}"


def _try(name: str, check: Callable[[], str]) -> DeviceFinding:
    try:
        return DeviceFinding(name, True, check())
    except DiscoError as error:
        return DeviceFinding(name, False, str(error))


C = TypeVar("C", bound=Closable)


@contextmanager
def _then(end: Callable[[], None]) -> Iterator[None]:
    """Something, and then this, whatever happened. What fails in it never takes the place of what went wrong before.

    At Ctrl-C the supervisor is faster than we are, and closing fails: that must not look like a test that failed,
    after which the next laser would be tried.
    """
    try:
        yield
    except BaseException:
        try:
            end()
        except DiscoError as error:
            log.info("closing: %s", error)
        raise
    end()


@contextmanager
def _using(device: C) -> Iterator[C]:
    """The device, closed at the end."""
    with _then(device.close):
        yield device


@contextmanager
def _light(clock: Clock, board: Board, laser: OmicronLaser) -> Iterator[Callable[[], None]]:
    """A laser and its gate; yields the way to tell both to go dark, as they are at once when anything goes wrong.

    In the end the laser is closed first, which one that does not answer draws out for seconds, then the lines are shut.
    """

    def darken_both() -> None:
        darken(clock, board, [laser])

    def shut() -> None:
        board.when_lost(lambda: None)  # the laser that would be told is closed by now
        board.shut()

    with _then(shut), _using(laser):
        try:
            yield darken_both
        except BaseException:
            darken_both()
            raise


def _try_on(name: str, opened: Callable[[], C], check: Callable[[C], str]) -> DeviceFinding:
    """Try a device that is opened for that."""

    def tried() -> str:
        with _using(opened()) as device:
            return check(device)

    return _try(name, tried)


def _cameras(file: DevicesFile, shapes: Shapes | None) -> list[tuple[str, Callable[[], GenicamCamera]]]:
    """The GenICam cameras: name, and how each is opened."""
    cameras = [camera for camera in file.cameras if isinstance(camera, GenicamDevice)]
    if cameras and shapes is None:
        raise InputError("GenICam cameras need the scene, which has their size", remedy="add --scene SCENE")
    return [(f"camera {device.name}", partial(open_camera, file, device, (shapes or {})[device.name]))
            for device in cameras]  # fmt: skip


def probe(file: DevicesFile, shapes: Shapes | None, logs: Path | None = None) -> Generator[DeviceFinding, None, None]:
    """Connect to every real device and let it identify itself. Lasers are switched off and gates shut by that.

    shapes: (height, width) of every camera by its name; needed for GenICam cameras alone
    """
    connect = Connector(file, logs=logs)
    for index, device in enumerate(file.lasers):
        if device.port != EMULATED:
            yield _try_on(device.title, partial(connect.omicron, index), _laser_identity)
    if file.board.port != EMULATED:
        yield _try_on("mirror board", connect.board, lambda board: "MM-Ard; every line low")
    if file.turntable.port != EMULATED:
        kind = file.turntable.kind
        yield _try_on("turntable", connect.table, lambda table: f"{kind}, at {np.rad2deg(table.angle_rad()):.2f} deg")
    if file.power_meter is not None and file.power_meter.port != EMULATED:
        yield _try_on("power meter", connect.meter, lambda meter: f"reads {1e3 * meter.read():.3f} mW")
    for name, opened in _cameras(file, shapes):
        yield _try_on(name, opened, lambda camera: camera.grabber.identity())


def _laser_identity(laser: OmicronLaser) -> str:
    found, mw = laser.identity, laser.require_off()
    kind = f"{found.model} {found.wavelength_nm:g} nm, {found.max_power_mw:g} mW"
    return f"{kind}, no. {found.serial_number}; off ({mw:.2f} mW)"


@contextmanager
def _metering(connect: Connector) -> Iterator[OphirMeter | None]:
    """The real power meter, where there is one: found before a laser emits, since that takes seconds."""
    device = connect.file.power_meter
    if device is None or device.port == EMULATED:
        yield None
    else:
        with _using(connect.meter()) as meter:
            yield meter


def selftest(
    file: DevicesFile, shapes: Shapes | None, armed: bool, logs: Path | None = None
) -> Generator[DeviceFinding, None, None]:
    """Exercise every real device. Lasers emit, one behind an open gate at a time, only if `armed`."""
    connect = Connector(file, logs=logs)
    lasers = {laser.title: i for i, laser in enumerate(file.lasers) if laser.port != EMULATED}
    off = [
        _try_on(f"{name}, off", partial(connect.omicron, i), lambda laser: f"{laser.require_off():.2f} mW while off")
        for name, i in lasers.items()
    ]
    yield from off
    board = None
    if file.board.port != EMULATED:
        try:
            board = connect.board()  # shuts the gates, whatever the lasers reported
        except DiscoError as error:
            yield DeviceFinding("mirror board", False, str(error))
            return
    try:
        if not all(finding.good for finding in off):  # what may be lit is neither let out nor moved about in
            yield DeviceFinding("gates", False, "left shut, and nothing moved: a laser did not confirm that it is off")
            return
        if file.turntable.port != EMULATED:
            yield _try_on("turntable", connect.table, partial(_test_table, file.turntable.kind))
        for name, opened in _cameras(file, shapes):
            yield _try_on(name, opened, partial(_test_camera, file))
        if board is not None:
            yield from _test_light(connect, board, lasers if armed else {})
    finally:
        if board is not None:
            close_all(connect.clock, [board])


def _test_light(connect: Connector, board: Board, lasers: Mapping[str, int]) -> Iterator[DeviceFinding]:
    """Mirrors, gates and photodiodes of a dark rig; then each of these lasers (name -> index)."""
    file = connect.file
    failed = []
    for what, test in (("mirrors", _test_mirrors), ("gates", _test_lines), ("photodiode, dark", _test_dark)):
        found = _try(what, partial(test, file, board))
        failed += [] if found.good else [what]
        yield found
    for name, index in lasers.items():
        if failed:
            yield DeviceFinding(name, False, f"not armed, since this failed: {', '.join(failed)}")
        else:
            yield _try(name, partial(_test_laser, connect, board, index))


def _test_table(kind: str, table: TurntableDriver) -> str:
    table.home()
    for angle in (TEST_ANGLE_DEG, 0.0):
        table.move(float(np.deg2rad(angle)))
        off = (np.rad2deg(table.angle_rad()) - angle + 180.0) % 360.0 - 180.0
        if abs(off) > ANGLE_TOLERANCE_DEG:
            problem = f"reports to be {off:+.3f} deg from {angle:g} deg (allowed: {ANGLE_TOLERANCE_DEG:g} off)"
            raise table.link.error(DeviceFault, problem, f"check {TABLE_KEY[kind]} in the rig file")
    return f"homed, turned to {TEST_ANGLE_DEG:g} deg and back"


def _test_camera(file: DevicesFile, camera: GenicamCamera) -> str:
    assert file.sensor is not None  # the rig file's own check
    black = require_black(camera, file.sensor)
    for _ in range(FRAMES):
        camera.expose()
    return f"{FRAMES} brackets, {camera.lost} frames taken again, black level {black:.1f} DN"


def _test_mirrors(file: DevicesFile, board: Board) -> str:
    for u in file.board.limits_u:
        for v in file.board.limits_v:
            board.set_mirrors(u, v)
    board.set_mirrors(*file.board.centre)
    return "took every corner of their limits (look whether they moved)"


def _test_lines(file: DevicesFile, board: Board) -> str:
    lines = [laser.gate_line for laser in file.lasers] + [file.board.floodlight_line, file.lamp_line]
    for line in lines:
        board.set_lines(1 << line)
        board.set_lines(0)
    return f"lines {', '.join(map(str, lines))} high and low one by one, read back"


def _test_dark(file: DevicesFile, board: Board) -> str:
    remedy = "shade it, or correct its amplifier's offset"
    read = [
        require_darkness(board.counts(laser.photodiode_pin), laser, "with every gate shut", remedy)
        for laser in file.lasers
    ]
    return f"{', '.join(map(str, read))} counts"


def _test_laser(connect: Connector, board: Board, index: int) -> str:
    """Emission behind its shut gate, then through it, against the set point; then off, gate open, against darkness.

    The gate is shut whenever a laser that is on is asked for something: one that falls silent is asked for seconds.
    """
    file, device = connect.file, connect.file.lasers[index]
    with _metering(connect) as meter, _light(connect.clock, board, laser := connect.omicron(index)) as darken_both:
        verified = VerifiedBoard(board, connect.clock, [entry.gate_line for entry in file.lasers], darken_both)
        verified.require_lines()
        verified.aim(*file.board.centre)
        (reading,) = begin_emission(connect.clock, file, verified, {index: laser})
        verified.require_lines()
        require_supervisor()
        verified.open_gate(device.gate_line)
        counts, own_mw = _counts(verified, device), 1e3 * reading.own_w
        read_mw = 1e3 * require_light(counts, device, own_mw)
        metered = "" if meter is None else _compared(meter.read(), counts)
        verified.switch(device.gate_line, False)
        laser.stop_emission()
        laser.require_off()
        verified.open_gate(device.gate_line)
        require_darkness(_counts(verified, device), device, "while it is off", "check the wiring of gate and interlock")
        return (
            f"set {device.power_mw:g} mW, own reading {own_mw:.2f} mW, photodiode {read_mw:.2f} mW ({counts} counts)"
            f"{metered}; off again"
        )


def _counts(board: VerifiedBoard, device: LaserDevice) -> int:
    """What the laser's photodiode reads, gates and mirrors being where they should be."""
    counts = board.counts(device.photodiode_pin)
    board.require_lines()
    return counts


def _compared(watts: float, counts: int) -> str:
    """The power meter's reading, and the watts_per_count that it asks for."""
    return f", power meter {1e3 * watts:.2f} mW: watts_per_count = {watts / max(counts, 1):.4g}"
