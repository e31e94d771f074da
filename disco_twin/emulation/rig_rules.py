"""Reads a rig file, and refuses what cannot be: two devices on one line, another scene's rig, a capture's other rig."""

from __future__ import annotations

import re
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from disco_twin.emulation.rig_file import (
    EMULATED,
    PROJECTOR_STEPS,
    DevicesFile,
    GenicamDevice,
    LaserDevice,
    SensorDevice,
)
from hw.base.errors import InputError, naming
from hw.devices.mm_ard import ADC_TOP, LINES, PINS
from hw.rig.serial_rig import DARK_COUNTS
from pipeline.geometry.nominal_rig import RigConfig
from pipeline.plan.plan import Plan

WAVELENGTH_TOLERANCE_NM = 10.0
SOCKET = re.compile(r"socket://[^/:?]+:\d{1,5}")  # a serial port that another machine serves
# What may change in the middle of a capture, since no image depends on it: where a device is plugged in, how long it is
# waited for, what is refused.
MAY_CHANGE = re.compile(
    r".*\.(port|baud|reach_s|photodiode_limits|black_tolerance_dn)|warm_up_s|power_tolerance|power_meter.*"
)


def load_rig_file(path: Path) -> DevicesFile:
    """Read and check a rig file."""
    rig = DevicesFile.load(path)
    with naming(path):
        _require_wiring(rig)
        _require_ranges(rig)
        _require_cameras(rig)
    return rig


# ---- within the file


def _require_distinct(what: str, used: Mapping[str, object], choice: str, remedy: str) -> None:
    """Refuse the second of two keys that name the same thing: a port's links are the port."""
    first: dict[object, str] = {}
    for key, value in used.items():
        try:
            thing = _device(value) if key.endswith(".port") else value
        except (ValueError, RuntimeError, OSError) as error:  # links that lead back to themselves
            raise InputError(f"leads nowhere ({error})", key=key, value=value, remedy=remedy) from error
        if thing in first:
            raise InputError(
                f"is {what} of {first[thing]} as well", key=key, value=value, allowed=choice, remedy=remedy
            )
        first[thing] = key


def _device(port: object) -> object:
    """What a port's name leads to, by whatever path or link."""
    if SOCKET.fullmatch(str(port)):
        return port
    path = Path(str(port)).resolve()
    if not path.exists():
        return path
    found = path.stat()
    return ("device", found.st_rdev) if stat.S_ISCHR(found.st_mode) else (found.st_dev, found.st_ino)


def _require_wiring(rig: DevicesFile) -> None:
    """Every line, pin and port has one user."""
    lines = {f"lasers[{i}].gate_line": laser.gate_line for i, laser in enumerate(rig.lasers)}
    lines["board.floodlight_line"] = rig.board.floodlight_line
    free = ", ".join(str(line) for line in range(LINES) if line not in lines.values())
    remedy = "give every gate and the floodlight a TTL line of its own"
    _require_distinct("the TTL line", lines, f"another of 0 to {LINES - 1}; free: {free}", remedy)
    pins = {f"lasers[{i}].photodiode_pin": laser.photodiode_pin for i, laser in enumerate(rig.lasers)}
    free = ", ".join(str(pin) for pin in range(PINS) if pin not in pins.values())
    remedy = "give every laser an analogue pin of its own: its gain is set for one power"
    _require_distinct("the analogue pin", pins, f"another of 0 to {PINS - 1}; free: {free}", remedy)
    ports = {key: port for key, port in rig.ports().items() if port != EMULATED}
    for key, port in ports.items():
        if "://" in port and not SOCKET.fullmatch(port):
            allowed, remedy = "a path, or socket://HOST:PORT", "name the device's path as in /dev/serial/by-id/..."
            raise InputError("is no port", key=key, value=port, allowed=allowed, remedy=remedy)
    remedy = "`ls -l /dev/serial/by-id` says which device is where; `disco-twin rig probe` asks them"
    _require_distinct("the port", ports, "one device a port", remedy)


def _require_ranges(rig: DevicesFile) -> None:
    """Limits in order, the centre within them, the converter's range above the power."""
    for name, centre in zip("uv", rig.board.centre, strict=True):
        low, high = limits = rig.board.limits_u if name == "u" else rig.board.limits_v
        if not low < high:
            allowed = f"lower < upper, within 0 to {PROJECTOR_STEPS - 1}"
            key, remedy = f"board.limits_{name}", "give the lower mirror step first"
            raise InputError("leaves the mirror no way", key=key, value=limits, allowed=allowed, remedy=remedy)
        if not low <= centre <= high:
            remedy = f"set board.centre within board.limits_{name}: the mirrors stand there at first"
            key, value = f"board.centre[{'uv'.index(name)}]", centre
            raise InputError("is outside the mirror's limits", key=key, value=value, allowed=f"{low} to {high}",
                             remedy=remedy)  # fmt: skip
    for i, laser in enumerate(rig.lasers):
        low_share, high_share = laser.photodiode_limits
        if not low_share < 1 < high_share:
            key, remedy = f"lasers[{i}].photodiode_limits", "they are shares of power_mw, as in [0.5, 1.5]"
            raise InputError("do not enclose 1", key=key, value=laser.photodiode_limits, allowed="lower < 1 < upper",
                             remedy=remedy)  # fmt: skip
        if low_share <= DARK_COUNTS / ADC_TOP:
            remedy = f"raise the lower one: up to {DARK_COUNTS} of the converter's {ADC_TOP} counts are darkness"
            raise InputError("tell no light from darkness", key=f"lasers[{i}].photodiode_limits",
                             value=laser.photodiode_limits, allowed=f"lower > {DARK_COUNTS / ADC_TOP:.2g}",
                             remedy=remedy)  # fmt: skip
        _require_counts(i, laser)


def _require_counts(index: int, laser: LaserDevice) -> None:
    """The photodiode's converter goes up to the power, and tells the least that is accepted from darkness."""
    power_w = 1e-3 * laser.power_mw
    least, most = power_w / ADC_TOP, power_w * laser.photodiode_limits[0] / DARK_COUNTS
    if least <= laser.watts_per_count < most:
        return
    if laser.watts_per_count < least:
        reason = "the photodiode's converter ends below power_mw"
    else:
        low = power_w * laser.photodiode_limits[0] / laser.watts_per_count
        reason = f"the lower of photodiode_limits is {low:.2g} counts, and up to {DARK_COUNTS} are darkness"
    problem = f"does not go with lasers[{index}].watts_per_count = {laser.watts_per_count:.4g}: {reason}"
    allowed = f"with this power, watts_per_count at least {least:.4g}, below {most:.4g}"
    remedy = (
        "one of the two is in another unit: power_mw in mW, watts_per_count in W (not mW) per count, measured with a "
        "power meter; or set the photodiode's gain so that full power is near 800 counts"
    )
    raise InputError(problem, key=f"lasers[{index}].power_mw", value=laser.power_mw, allowed=allowed, remedy=remedy)


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
    _require_distinct("the address", real, "one camera an address", "`disco-twin rig probe` says which camera is where")
    if real and rig.sensor is None:
        raise InputError(
            "required table is missing", key="sensor", remedy="GenICam cameras need [sensor]: see docs/lab.md"
        )
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
        raise InputError(error.problem, key=f"sensor.{error.key}", value=error.value, allowed=error.allowed,
                         remedy=remedy) from None  # fmt: skip
    if not sensor.black_dn < sensor.saturation_dn:
        raise InputError("is no black level", key="sensor.black_dn", value=sensor.black_dn,
                         allowed=f"below saturation_dn = {sensor.saturation_dn}",
                         remedy="it is the mean of a dark frame")  # fmt: skip


# ---- against the scene


def require_scene(rig: DevicesFile, scene: RigConfig, path: Path) -> None:
    """Refuse a rig file that is not this scene's rig."""

    def wrong(problem: str, key: str, value: object, allowed: object) -> InputError:
        remedy = "take the scene of this rig, or the rig file of this scene"
        return InputError(problem, file=path, key=key, value=value, allowed=str(allowed), remedy=remedy)

    if len(rig.lasers) != len(scene.lasers):
        raise wrong("the scene has other lasers", "lasers", len(rig.lasers), len(scene.lasers))
    for i, (laser, nominal) in enumerate(zip(rig.lasers, scene.lasers, strict=True)):
        if abs(laser.wavelength_nm - nominal.wavelength_nm) > WAVELENGTH_TOLERANCE_NM:
            allowed = f"{nominal.wavelength_nm:g} within {WAVELENGTH_TOLERANCE_NM:g}"
            raise wrong("the scene has another laser", f"lasers[{i}].wavelength_nm", laser.wavelength_nm, allowed)
    names = [camera.name for camera in rig.cameras]
    expected = [camera.name for camera in scene.cameras]
    if names != expected:
        raise wrong("the scene has other cameras", "cameras", names, expected)
    if scene.projector.steps != PROJECTOR_STEPS:
        raise wrong("the board's mirrors have other steps than rig.projector.steps of the scene", "board",
                    PROJECTOR_STEPS, scene.projector.steps)  # fmt: skip


def require_reach(rig: DevicesFile, plan: Plan, path: Path) -> None:
    """Refuse mirror limits that the plan's spots leave, before hours of images and not at the first such spot."""
    for name, limits in (("u", rig.board.limits_u), ("v", rig.board.limits_v)):
        steps = [getattr(aim, name) for aim in plan.spots]
        if steps and not limits[0] <= min(steps) <= max(steps) <= limits[1]:
            outside = sum(not limits[0] <= step <= limits[1] for step in steps)
            raise InputError(
                f"{outside} of the scene's {len(steps)} spots lie outside",
                file=path,
                key=f"board.limits_{name}",
                value=limits,
                allowed=f"at most {min(steps)} and at least {max(steps)}",
                remedy="widen the limits if the beam is safe there, or correct rig.projector in the scene",
            )


# ---- against the capture that is to be continued


def require_same(rig: DevicesFile, begun_with: DevicesFile, path: Path) -> None:
    """Refuse to continue a capture with another rig than it was begun with: its images would not belong together."""
    now, then = dict(_leaves(rig.model_dump())), dict(_leaves(begun_with.model_dump()))
    for key in [*then, *(key for key in now if key not in then)]:
        if not _same(key, now, then):
            was = f"was begun with {_words(then.get(key))}" if key in then else "was begun without it"
            raise InputError(
                f"the capture in this folder {was}",
                file=path,
                key=key,
                value=now.get(key, "nothing"),
                remedy="set it back, or choose another --out",
            )


def _same(key: str, now: Mapping[str, Any], then: Mapping[str, Any]) -> bool:
    if key.endswith(".port") and not key.startswith("power_meter"):
        return (now.get(key) == EMULATED) == (then.get(key) == EMULATED)
    if key.startswith("cameras") and key.endswith(".address"):
        serial = key.replace(".address", ".serial")  # says which camera it is, wherever it is
        return now.get(key) == then.get(key) or now.get(serial) == then.get(serial) is not None
    return MAY_CHANGE.fullmatch(key) is not None or now.get(key) == then.get(key)


def _words(value: object) -> str:
    return "none" if value is None else str(list(value)) if isinstance(value, tuple) else repr(value)


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """`lasers[0].power_mw` and its value, for every value of nested tables."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _leaves(inner, f"{key}.{name}" if key else name)
    elif isinstance(value, tuple) and value and isinstance(value[0], dict):
        for number, inner in enumerate(value):
            yield from _leaves(inner, f"{key}[{number}]")
    else:
        yield key, value
