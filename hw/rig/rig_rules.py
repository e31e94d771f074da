"""Reads a rig file, and refuses a rig that cannot be: two devices on one port, limits that exclude the centre."""

from __future__ import annotations

import re
import stat
from collections.abc import Mapping
from pathlib import Path

from hw.base.errors import InputError, naming
from hw.devices.mm_ard import ADC_TOP, LINES, PINS
from hw.rig.rig_file import (
    DARK_COUNTS,
    EMULATED,
    PROJECTOR_STEPS,
    BoardDevice,
    DevicesFile,
    GenicamDevice,
    LaserDevice,
    SensorDevice,
)

SOCKET = re.compile(r"socket://[^/:?]+:\d{1,5}")  # a serial port that another machine serves


def load_rig_file(path: Path) -> DevicesFile:
    """Read and check a rig file.

    Raises: InputError that names file, key, value, what is allowed and the remedy.
    """
    rig = DevicesFile.load(path)
    with naming(path):
        _require_wiring(rig)
        _require_mirrors(rig.board)
        for index, laser in enumerate(rig.lasers):
            _require_photodiode(f"lasers[{index}]", laser)
        _require_cameras(rig)
    return rig


# ---- one user each


def _require_distinct(what: str, used: Mapping[str, object], choice: str, remedy: str) -> None:
    """Refuse the second of two keys that name the same thing: a port's links are the port."""
    first: dict[object, str] = {}
    for key, value in used.items():
        try:
            thing = _device(str(value)) if key.endswith(".port") else value
        except (ValueError, RuntimeError, OSError) as error:  # links that lead back to themselves
            raise InputError(f"leads nowhere ({error})", key=key, value=value, remedy=remedy) from error
        if thing in first:
            problem = f"is {what} of {first[thing]} as well"
            raise InputError(problem, key=key, value=value, allowed=choice, remedy=remedy)
        first[thing] = key


def _device(port: str) -> object:
    """What a port's name leads to, by whatever path or link."""
    if SOCKET.fullmatch(port):
        return port
    path = Path(port).resolve()
    if not path.exists():
        return path
    found = path.stat()
    return ("device", found.st_rdev) if stat.S_ISCHR(found.st_mode) else (found.st_dev, found.st_ino)


def _require_wiring(rig: DevicesFile) -> None:
    """Every line, pin and port has one user."""
    lines = {f"lasers[{i}].gate_line": laser.gate_line for i, laser in enumerate(rig.lasers)}
    lines["board.floodlight_line"] = rig.board.floodlight_line
    pins = {f"lasers[{i}].photodiode_pin": laser.photodiode_pin for i, laser in enumerate(rig.lasers)}
    for what, used, count, remedy in (
        ("the TTL line", lines, LINES, "give every gate and the floodlight a TTL line of its own"),
        ("the analogue pin", pins, PINS, "give every laser an analogue pin of its own: its gain is set for one power"),
    ):
        free = ", ".join(str(number) for number in range(count) if number not in used.values())
        _require_distinct(what, used, f"another of 0 to {count - 1}; free: {free}", remedy)
    ports = {key: port for key, port in rig.ports().items() if port != EMULATED}
    for key, port in ports.items():
        if "://" in port and not SOCKET.fullmatch(port):
            allowed, remedy = "a path, or socket://HOST:PORT", "name the device's path as in /dev/serial/by-id/..."
            raise InputError("is no port", key=key, value=port, allowed=allowed, remedy=remedy)
    remedy = "`ls -l /dev/serial/by-id` lists which device is where; `disco-twin rig probe` asks them"
    _require_distinct("the port", ports, "one device a port", remedy)


# ---- ranges


def _require_mirrors(board: BoardDevice) -> None:
    """Limits in order, the centre within them."""
    for axis, (name, centre) in enumerate(zip("uv", board.centre, strict=True)):
        low, high = limits = (board.limits_u, board.limits_v)[axis]
        if not low < high:
            allowed = f"lower < upper, within 0 to {PROJECTOR_STEPS - 1}"
            key, remedy = f"board.limits_{name}", "give the lower mirror step first"
            raise InputError("leaves the mirror no way", key=key, value=limits, allowed=allowed, remedy=remedy)
        if not low <= centre <= high:
            problem, key = "is outside the mirror's limits", f"board.centre[{axis}]"
            remedy = f"set board.centre within board.limits_{name}: the mirrors stand there at first"
            raise InputError(problem, key=key, value=centre, allowed=f"{low} to {high}", remedy=remedy)


def _require_photodiode(table: str, laser: LaserDevice) -> None:
    """The converter goes up to the power, and the least that is accepted stands out of darkness."""
    key, limits, power_w = f"{table}.photodiode_limits", laser.photodiode_limits, 1e-3 * laser.power_mw
    if not limits[0] < 1 < limits[1]:
        remedy = "they are shares of power_mw, as in [0.5, 1.5]"
        raise InputError("do not enclose 1", key=key, value=limits, allowed="lower < 1 < upper", remedy=remedy)
    if limits[0] <= DARK_COUNTS / ADC_TOP:
        allowed = f"lower > {DARK_COUNTS / ADC_TOP:.2g}"
        remedy = f"raise the lower one: up to {DARK_COUNTS} of the converter's {ADC_TOP} counts are darkness"
        raise InputError("do not separate light from darkness", key=key, value=limits, allowed=allowed, remedy=remedy)
    least, most = power_w / ADC_TOP, power_w * limits[0] / DARK_COUNTS
    if least <= laser.watts_per_count < most:
        return
    if laser.watts_per_count < least:
        reason = "the photodiode's converter ends below power_mw"
    else:
        low = power_w * limits[0] / laser.watts_per_count
        reason = f"the lower of photodiode_limits is {low:.2g} counts, and up to {DARK_COUNTS} are darkness"
    raise InputError(
        f"does not go with {table}.watts_per_count = {laser.watts_per_count:.4g}: {reason}",
        key=f"{table}.power_mw",
        value=laser.power_mw,
        allowed=f"with this power, watts_per_count at least {least:.4g}, below {most:.4g}",
        remedy="one of the two is in another unit: power_mw in mW, watts_per_count in W (not mW) per count, measured "
        "with a power meter; or set the photodiode's gain so that full power is near 800 counts",
    )


def _require_cameras(rig: DevicesFile) -> None:
    """All real or all simulated, each once, with a sensor that can be."""
    kinds = [camera.kind for camera in rig.cameras]
    if len(set(kinds)) > 1:
        other = next(i for i, kind in enumerate(kinds) if kind != kinds[0])
        raise InputError("the cameras share one sensor", key=f"cameras[{other}].kind", value=kinds[other],
                         allowed="all genicam or all simulated", remedy=f"make it {kinds[0]}")  # fmt: skip
    _require_distinct("the name", {f"cameras[{i}].name": camera.name for i, camera in enumerate(rig.cameras)},
                      "the scene's cameras", "name every camera of the scene once")  # fmt: skip
    real = {f"cameras[{i}].address": c.address for i, c in enumerate(rig.cameras) if isinstance(c, GenicamDevice)}
    _require_distinct("the address", real, "one camera an address", "`disco-twin rig probe` lists where they are")
    if real and rig.sensor is None:
        remedy = "GenICam cameras need [sensor]: see docs/lab.md"
        raise InputError("required table is missing", key="sensor", remedy=remedy)
    if rig.sensor is None:
        return
    _require_sensor(rig.sensor, len(rig.lasers))
    for i, camera in enumerate(rig.cameras):
        if isinstance(camera, GenicamDevice) and int(camera.pixel_format[4:6]) < rig.sensor.bits:
            raise InputError("has fewer bits than sensor.bits", key=f"cameras[{i}].pixel_format",
                             value=camera.pixel_format, allowed=f"Mono{rig.sensor.bits} or deeper",
                             remedy="name a deeper format, or lower sensor.bits")  # fmt: skip


def _require_sensor(sensor: SensorDevice, lasers: int) -> None:
    if len(sensor.responsivity) != lasers:
        raise InputError("needs a value for every laser", key="sensor.responsivity", value=sensor.responsivity,
                         allowed=f"{lasers} values", remedy="measure it, see docs/lab.md")  # fmt: skip
    try:
        sensor.bracket()
    except InputError as error:
        remedy = error.remedy or "see docs/lab.md, section 3"
        raise error.amended(key=f"sensor.{error.key}", remedy=remedy) from None
    if not sensor.black_dn < sensor.saturation_dn:
        raise InputError("is no black level", key="sensor.black_dn", value=sensor.black_dn,
                         allowed=f"below saturation_dn = {sensor.saturation_dn}",
                         remedy="it is the mean of a dark frame")  # fmt: skip
