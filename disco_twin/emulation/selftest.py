"""`disco-twin rig probe | selftest`: what is on the ports, and does it work."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from disco_twin.emulation.connect import Connector, free_line, open_camera, require_black
from disco_twin.emulation.rig_file import EMULATED, DevicesFile, GenicamDevice, LaserDevice
from disco_twin.experiment.run_folder import require_folder
from hw.base.clock import Clock, WallClock
from hw.base.errors import DeviceFault, DiscoError, InputError
from hw.devices.mm_ard import ADC_TOP
from hw.devices.omicron import OmicronLaser
from hw.devices.ophir import OphirMeter
from hw.rig.serial_rig import DARK_COUNTS, cut_light, require_darkness, warm_up
from hw.rig.verified_board import VerifiedBoard
from hw.rig.wiring import Board, Closable
from pipeline.geometry.nominal_rig import RigConfig

log = logging.getLogger(__name__)

TEST_ANGLE_DEG = 30.0
ANGLE_TOLERANCE_DEG = 0.05
FRAMES = 20


@dataclass(frozen=True)
class Finding:
    """One line of a probe or self-test."""

    name: str
    good: bool
    text: str

    def __str__(self) -> str:
        return f"{'ok  ' if self.good else 'FAIL'}  {self.name:<22} {self.text}"


def _try(name: str, check: Callable[[], str]) -> Finding:
    try:
        return Finding(name, True, check())
    except DiscoError as error:
        return Finding(name, False, str(error))


C = TypeVar("C", bound=Closable)


@contextmanager
def _then(end: Callable[[], None]) -> Iterator[None]:
    """Something, and then this, whatever happened. What fails in it never takes the place of what went wrong before.

    At Ctrl-C a laser's guard is faster than we are, and closing fails: that must not look like a test that failed,
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
def _light(clock: Clock, board: Board, head: OmicronLaser) -> Iterator[Callable[[], None]]:
    """A laser and its gate, and how both are told to go dark: so they are at once when anything goes wrong.

    In the end the laser is closed first, which one that does not answer draws out for seconds, then the lines are shut.
    """

    def cut() -> None:
        cut_light(clock, board, [head])

    def shut() -> None:
        board.when_lost(lambda: None)  # the laser that would be told is closed by now
        board.shut()

    with _then(shut), _using(head):
        try:
            yield cut
        except BaseException:
            cut()
            raise


def _connector(file: DevicesFile, logs: Path | None) -> Connector:
    """For real devices: what is emulated is left out by the callers."""
    if logs is not None:
        require_folder(logs, "--logs")
    return Connector(file, WallClock(), None, logs)


def _shapes(file: DevicesFile, scene: RigConfig | None) -> list[tuple[GenicamDevice, tuple[int, int]]]:
    """The GenICam cameras and their (height, width), which the scene knows."""
    cameras = [camera for camera in file.cameras if isinstance(camera, GenicamDevice)]
    if cameras and scene is None:
        raise InputError("GenICam cameras need the scene, which knows their size", remedy="add --scene SCENE")
    sizes = {} if scene is None else {camera.name: (camera.height, camera.width) for camera in scene.cameras}
    return [(camera, sizes[camera.name]) for camera in cameras]


def probe(file: DevicesFile, scene: RigConfig | None, logs: Path | None = None) -> Generator[Finding, None, None]:
    """Connect to every real device and let it say what it is. Lasers are switched off and gates shut by that."""
    connect = _connector(file, logs)

    def laser(index: int) -> str:
        with _using(connect.omicron(index)) as head:
            found, mw = head.identity, head.require_off()
        kind = f"{found.model} {found.wavelength_nm:g} nm, {found.max_power_mw:g} mW"
        return f"{kind}, no. {found.serial_number}; off ({mw:.2f} mW)"

    def board() -> str:
        with _using(connect.board()):
            return "MM-Ard; every line low"

    def table() -> str:
        with _using(connect.table()) as driver:
            return f"{file.turntable.kind}, at {np.rad2deg(driver.angle_rad()):.2f} deg"

    for index, device in enumerate(file.lasers):
        if device.port != EMULATED:
            yield _try(f"laser {device.wavelength_nm:g} nm", partial(laser, index))
    if file.board.port != EMULATED:
        yield _try("mirror board", board)
    if file.turntable.port != EMULATED:
        yield _try("turntable", table)
    if file.power_meter is not None and file.power_meter.port != EMULATED:
        yield _try("power meter", partial(_meter_reads, connect))
    for device_, shape in _shapes(file, scene):
        yield _try(f"camera {device_.name}", partial(_camera_says, file, device_, shape))


def _meter_reads(connect: Connector) -> str:
    with _using(connect.meter()) as meter:
        return f"reads {1e3 * meter.read():.3f} mW"


@contextmanager
def _metering(connect: Connector) -> Iterator[OphirMeter | None]:
    """The real power meter, where there is one: found before a laser emits, since that takes seconds."""
    device = connect.file.power_meter
    if device is None or device.port == EMULATED:
        yield None
    else:
        with _using(connect.meter()) as meter:
            yield meter


def _camera_says(file: DevicesFile, device: GenicamDevice, shape: tuple[int, int]) -> str:
    assert file.sensor is not None
    with _using(open_camera(file, device, shape)) as camera:
        return camera.grabber.identity()


def selftest(
    file: DevicesFile, scene: RigConfig | None, armed: bool, logs: Path | None = None
) -> Generator[Finding, None, None]:
    """Exercise every real device. Lasers emit, one behind an open gate at a time, only if `armed`."""
    connect = _connector(file, logs)
    real = [i for i, laser in enumerate(file.lasers) if laser.port != EMULATED]
    heads = {f"laser {file.lasers[i].wavelength_nm:g} nm": i for i in real}
    off = [_try(f"{name}, off", partial(_test_off, connect, index)) for name, index in heads.items()]
    yield from off
    board = None
    if file.board.port != EMULATED:
        try:
            board = connect.board()  # shuts the gates, whatever the lasers said
        except DiscoError as error:
            yield Finding("mirror board", False, str(error))
            return
    try:
        if not all(finding.good for finding in off):  # what may be lit is neither let out nor moved about in
            yield Finding("gates", False, "left shut, and nothing moved: a laser did not say that it is off")
            return
        if file.turntable.port != EMULATED:
            yield _try("turntable", lambda: _test_table(connect))
        for device, shape in _shapes(file, scene):
            yield _try(f"camera {device.name}", partial(_test_camera, file, device, shape))
        if board is not None:
            yield from _test_light(connect, board, heads if armed else {})
    finally:
        if board is not None:
            try:
                board.close()
            except DiscoError as error:
                log.warning("%s", error)


def _test_light(connect: Connector, board: Board, heads: Mapping[str, int]) -> Iterator[Finding]:
    """Mirrors, gates and photodiodes of a dark rig; then each of these lasers (name -> index)."""
    file = connect.file
    yield _try("mirrors", lambda: _test_mirrors(file, board))
    yield _try("gates", lambda: _test_lines(file, board))
    yield _try("photodiode, dark", lambda: _test_dark(file, board))
    for name, index in heads.items():
        yield _try(name, partial(_test_laser, connect, board, index))


def _test_table(connect: Connector) -> str:
    with _using(connect.table()) as table:
        table.home()
        for angle in (TEST_ANGLE_DEG, 0.0):
            table.move(float(np.deg2rad(angle)))
            off = (np.rad2deg(table.angle_rad()) - angle + 180.0) % 360.0 - 180.0
            if abs(off) > ANGLE_TOLERANCE_DEG:
                problem = (
                    f"says that it stands {off:+.3f} deg from {angle:g} deg (allowed: {ANGLE_TOLERANCE_DEG:g} off)"
                )
                raise DeviceFault(table.link.url, "turntable", problem, "check microsteps_per_deg in the rig file")
        return f"homed, turned to {TEST_ANGLE_DEG:g} deg and back"


def _test_camera(file: DevicesFile, device: GenicamDevice, shape: tuple[int, int]) -> str:
    assert file.sensor is not None
    with _using(open_camera(file, device, shape)) as camera:
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
    lines = [laser.gate_line for laser in file.lasers] + [file.board.floodlight_line, free_line(file)]
    for line in lines:
        board.set_lines(1 << line)
        board.set_lines(0)
    return f"lines {', '.join(map(str, lines))} high and low one by one, read back"


def _test_dark(file: DevicesFile, board: Board) -> str:
    seen = []
    for laser in file.lasers:
        seen.append(board.counts(laser.photodiode_pin))
        name, remedy = f"laser {laser.wavelength_nm:g} nm", "shade it, or correct its amplifier's offset"
        require_darkness(seen[-1], laser.photodiode_pin, name, "with every gate shut", remedy)
    return f"{', '.join(map(str, seen))} counts"


def _test_off(connect: Connector, index: int) -> str:
    with _using(connect.omicron(index)) as head:
        return f"{head.require_off():.2f} mW while off"


def _test_laser(connect: Connector, board: Board, index: int) -> str:
    """Emission behind its shut gate, then through it, against the set point; then off, gate open, against darkness.

    The gate is shut whenever a laser that is on is told something, since one that falls silent is asked for seconds.
    """
    file, wiring = connect.file, connect.file.lasers[index]
    with _metering(connect) as meter, _light(connect.clock, board, head := connect.omicron(index)) as cut:
        trusted = VerifiedBoard(board, connect.clock, [laser.gate_line for laser in file.lasers], cut)
        trusted.require_lines()
        trusted.aim(*file.board.centre)
        trusted.switch(free_line(file), True)
        head.arm(wiring.power_mw)
        head.emit()
        warm_up(connect.clock, file.warm_up_s, [head])
        own = head.require_power(file.power_tolerance)
        _require_dark(trusted, wiring, head.name, "while it emits behind its shut gate", "see that its gate shuts")
        head.require_guard()
        trusted.open_gate(wiring.gate_line)
        seen = _through_gate(trusted, wiring, head.name, own)
        counts = round(1e-3 * seen / wiring.watts_per_count)
        metered = "" if meter is None else _meter_says(meter.read(), counts)
        trusted.switch(wiring.gate_line, False)
        head.stop_emission()
        head.require_off()
        trusted.open_gate(wiring.gate_line)
        _require_dark(trusted, wiring, head.name, "while it is off", "check the wiring of gate and interlock")
        return (
            f"set {wiring.power_mw:g} mW, own reading {own:.2f} mW, photodiode {seen:.2f} mW ({counts} counts)"
            f"{metered}; off again"
        )


def _meter_says(watts: float, counts: int) -> str:
    """The power meter's reading, and the watts_per_count that it asks for."""
    return f", power meter {1e3 * watts:.2f} mW: watts_per_count = {watts / max(counts, 1):.4g}"


def _require_dark(board: VerifiedBoard, wiring: LaserDevice, name: str, when: str, remedy: str) -> None:
    counts = board.counts(wiring.photodiode_pin)
    board.require_lines()
    require_darkness(counts, wiring.photodiode_pin, name, when, remedy)


def _through_gate(board: VerifiedBoard, wiring: LaserDevice, name: str, own_mw: float) -> float:
    """Power at the photodiode behind the open gate, in mW; own_mw: by the laser's own reading."""
    counts, pin = board.counts(wiring.photodiode_pin), f"pin {wiring.photodiode_pin}"
    board.require_lines()
    if counts >= ADC_TOP:
        problem = f"saturates its photodiode ({counts} counts; allowed: below {ADC_TOP})"
        raise DeviceFault(pin, name, problem, "lower the gain of its amplifier, then measure watts_per_count anew")
    seen = 1e3 * counts * wiring.watts_per_count
    low, high = (share * wiring.power_mw for share in wiring.photodiode_limits)
    if not low <= seen <= high:
        problem = (
            f"gives {seen:.2f} mW ({counts} counts) at the photodiode through its open gate "
            f"(allowed: {low:g} to {high:g} mW)"
        )
        remedy = "check gate_line, photodiode_pin and the amplifier's gain"
        if counts > DARK_COUNTS:
            fitting = 1e-3 * own_mw / counts
            remedy += f"; if they are right, watts_per_count is near {fitting:.3g} by the laser's own reading"
        raise DeviceFault(pin, name, problem, remedy)
    return seen


# ---- the rig file of emulated devices


def rig_file_of(scene: RigConfig, ports: dict[str, str]) -> str:
    """The rig file of a scene's emulated rig, as TOML; `ports` by name of the line, `emulated` where none is given."""
    from disco_twin.emulation.bench import FLOOD_LINE
    from disco_twin.emulation.twin_rig import watts_per_count
    from disco_twin.firmware.zaber import MICROSTEPS_PER_DEG

    parts = ["format_version = 1", "warm_up_s = 0.0 # emulated lasers have nothing to warm up", ""]
    for i, laser in enumerate(scene.lasers):
        parts += [
            "[[lasers]]",
            'kind = "omicron"',
            f'port = "{ports.get(f"laser{i}", EMULATED)}"',
            f"wavelength_nm = {laser.wavelength_nm}",
            f"power_mw = {laser.power_mw}",
            f"gate_line = {i}",
            f"photodiode_pin = {i}",
            f"watts_per_count = {watts_per_count(laser)!r}",
            "photodiode_limits = [0.1, 1.5] # the twin's lasers start cold",
            "",
        ]
    parts += ["[board]", 'kind = "mm-ard"', f'port = "{ports.get("board", EMULATED)}"']
    parts += [f"floodlight_line = {FLOOD_LINE}", ""]
    parts += ["[turntable]", 'kind = "zaber"', f'port = "{ports.get("turntable", EMULATED)}"']
    parts += [f"microsteps_per_deg = {MICROSTEPS_PER_DEG!r}", ""]
    for camera in scene.cameras:
        parts += ["[[cameras]]", 'kind = "simulated"', f'name = "{camera.name}"', ""]
    return "\n".join(parts)
