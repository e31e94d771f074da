"""images.csv: which file is which frame of which image; and the plan that these images make up."""

from __future__ import annotations

import csv
import itertools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hw.base.errors import InputError
from hw.interface import Aim
from pipeline.capture.import_description import CaptureDescription
from pipeline.geometry.nominal_rig import RigConfig
from pipeline.plan.plan import ImageAddress, Plan
from pipeline.stream.layout import ImageMeta

COLUMNS = ("file", "kind", "camera", "angle_deg", "u", "v", "laser_nm", "exposure_s", "power_w", "time_s")
EXPOSURE_SHARE = 0.01  # by which an exposure may miss its power of two: as much is the radiance off
ANGLE_DEG = 0.01
WAVELENGTH_NM = 1.0
MOST_POWER = 2.0  # times rig.lasers.power_mw, that may arrive at the object


@dataclass(frozen=True)
class Frame:
    """One line of the table. exponent: halvings of the longest exposure."""

    line: int
    file: Path
    exponent: int
    power_w: float
    time_s: float


Key = tuple[int, int, int, int, int]  # camera, angle, u, v, laser; a silhouette has u = v = laser = -1


def read_table(path: Path, described: CaptureDescription) -> dict[Key, list[Frame]]:
    """The frames of every image, by falling exposure. Raises: InputError, with the line where there is one."""
    brackets: dict[Key, list[Frame]] = {}
    seen: dict[Path, int] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file)
            missing = [name for name in COLUMNS if name not in (rows.fieldnames or ())]
            if missing:
                remedy = "name the columns in the first line, separated by commas"
                raise InputError(f"has no column {missing[0]!r}", file=path, allowed=", ".join(COLUMNS), remedy=remedy)
            for row in rows:
                key, frame = _row(path, rows.line_num, row, described)
                if (other := seen.setdefault(frame.file.resolve(), frame.line)) != frame.line:
                    problem = f"lines {other} and {frame.line} name the same file"
                    raise InputError(problem, file=path, key="file", value=row["file"], remedy="correct one of them")
                brackets.setdefault(key, []).append(frame)
    except OSError as error:
        problem, remedy = f"cannot be read ({error.strerror})", "docs/lab.md has an example"
        raise InputError(problem, file=path, remedy=remedy) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"is not a table ({error})", file=path, remedy="save it as CSV in UTF-8") from error
    for frames in brackets.values():
        frames.sort(key=lambda frame: frame.exponent)
        for a, b in itertools.pairwise(frames):
            if a.exponent == b.exponent:
                problem = f"lines {a.line} and {b.line} are the same image with the same exposure"
                raise InputError(problem, file=path, remedy="leave one of them out")
    return brackets


def _row(path: Path, line: int, row: dict[Any, Any], described: CaptureDescription) -> tuple[Key, Frame]:
    rig, sensor = described.rig, described.sensor

    def wrong(column: str, allowed: str) -> InputError:
        remedy = f"correct {column} in that line, or leave the line out"
        value = "" if row[column] is None else row[column]
        return InputError(
            f"line {line} cannot be used", file=path, key=column, value=value, allowed=allowed, remedy=remedy
        )

    def number(column: str, allowed: str) -> float:
        try:
            value = float(row[column])
        except (TypeError, ValueError):
            raise wrong(column, allowed) from None
        if not math.isfinite(value):
            raise wrong(column, allowed)
        return value

    if None in row:  # what csv makes of values beyond the last column
        remedy = "write numbers with a point and texts with a comma in quotes"
        raise InputError(f"line {line} has more values than columns", file=path, remedy=remedy)
    if not row["file"]:
        raise wrong("file", "a file's name")
    if "\\" in row["file"] and not (path.parent / row["file"]).exists():
        raise wrong("file", "folders separated by /")
    names = [camera.name for camera in rig.cameras]
    if row["camera"] not in names:
        raise wrong("camera", ", ".join(names))
    if row["kind"] not in ("silhouette", "spot"):
        raise wrong("kind", "silhouette, spot")
    angles = rig.turntable_angles_deg
    angle = _nearest(number("angle_deg", "an angle"), angles, ANGLE_DEG, 360.0)
    if angle is None:
        raise wrong("angle_deg", ", ".join(f"{a:g}" for a in angles))
    share = sensor.longest_exposure_s / max(number("exposure_s", "seconds"), 1e-12)
    exponent = round(math.log2(share)) if share > 0 else -1
    if not 0 <= exponent < sensor.steps or abs(share / 2.0**exponent - 1) > EXPOSURE_SHARE:
        raise wrong("exposure_s", f"{sensor.longest_exposure_s:g} s / 2^k, k = 0 to {sensor.steps - 1}")
    frame = Frame(line, path.parent / row["file"], exponent, 0.0, number("time_s", "seconds"))
    camera = names.index(row["camera"])
    if row["kind"] == "silhouette":
        return (camera, angle, -1, -1, -1), frame
    laser = _nearest(number("laser_nm", "nm"), [la.wavelength_nm for la in rig.lasers], WAVELENGTH_NM, math.inf)
    if laser is None:
        raise wrong("laser_nm", ", ".join(f"{la.wavelength_nm:g}" for la in rig.lasers))
    top = rig.projector.steps - 1

    def step(column: str) -> int:
        value = number(column, f"0 to {top}")
        if value != int(value) or not 0 <= value <= top:
            raise wrong(column, f"whole steps, 0 to {top}")
        return int(value)

    u, v = step("u"), step("v")
    power = number("power_w", "watts on the object, more than 0")
    if power <= 0:
        raise wrong("power_w", "watts on the object, more than 0")
    if power > MOST_POWER * (most := rig.lasers[laser].power_mw * 1e-3):
        raise InputError(
            f"line {line} has {power / most:.3g} times the laser's power, rig.lasers.power_mw = {most * 1e3:g}",
            file=path,
            key="power_w",
            value=row["power_w"],
            allowed=f"watts on the object, at most {MOST_POWER * most:g}",
            remedy="convert it to watts, or correct rig.lasers.power_mw",
        )
    return (camera, angle, u, v, laser), Frame(line, frame.file, exponent, power, frame.time_s)


def _nearest(value: float, choices: tuple[float, ...] | list[float], tolerance: float, period: float) -> int | None:
    """The choice that is meant."""
    away = [abs(math.remainder(value - choice, period)) for choice in choices]
    best = min(range(len(choices)), key=away.__getitem__)
    return best if away[best] <= tolerance else None


def plan_of(path: Path, rig: RigConfig, brackets: dict[Key, list[Frame]]) -> Plan:
    """Spots in the order of the table, grouped by angle; every view must have all of its angle's, in all lasers."""
    order: dict[tuple[int, int, int], None] = dict.fromkeys(key[1:4] for key in brackets if key[4] >= 0)
    aims = tuple(Aim(*aim) for aim in sorted(order, key=lambda aim: aim[0]))  # stable
    angles = tuple(float(a) for a in np.deg2rad(rig.turntable_angles_deg))
    plan = Plan(tuple(camera.name for camera in rig.cameras), angles, aims, len(rig.lasers))
    missing = [address for address in plan.addresses() if key_of(plan, address) not in brackets]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(plan)} images are missing, the first is {words_of(rig, plan, missing[0])}",
            file=path,
            remedy="every camera needs, at every angle, a silhouette and all spots in all lasers; leave incomplete "
            "spots, cameras or angles out of images.csv and capture.toml",
        )
    return plan


def key_of(plan: Plan, address: ImageAddress) -> Key:
    camera, angle = plan.camera_of(address.view), plan.angle_of(address.view)
    if address.kind == "silhouette":
        return (camera, angle, -1, -1, -1)
    aim = plan.spots[address.spot]
    return (camera, angle, aim.u, aim.v, address.laser)


def words_of(rig: RigConfig, plan: Plan, address: ImageAddress) -> str:
    camera, angle, u, v, laser = key_of(plan, address)
    place = f"camera {rig.cameras[camera].name}, {rig.turntable_angles_deg[angle]:g} deg"
    return place + (", silhouette" if laser < 0 else f", u {u}, v {v}, {rig.lasers[laser].wavelength_nm:g} nm")


def meta_of(plan: Plan, address: ImageAddress, frames: list[Frame]) -> ImageMeta:
    """Power: the mean of the bracket's, by exposure; time: its last frame's."""
    angle = plan.angles_rad[plan.angle_of(address.view)]
    time_s = max(frame.time_s for frame in frames)
    if address.kind == "silhouette":
        return ImageMeta(time_s, 0.0, angle, -1, -1)
    aim, weights = plan.spots[address.spot], [2.0**-frame.exponent for frame in frames]
    power = float(np.average([frame.power_w for frame in frames], weights=weights))
    return ImageMeta(time_s, power, angle, aim.u, aim.v)
