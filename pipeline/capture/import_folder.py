"""Captures that were made without our software: a folder of 16-bit images, a table and a description -> our stream.

FOLDER/capture.toml   `CaptureDescription`: the nominal rig as in a scene, what is known of the sensor, the scan's file
FOLDER/images.csv     one line a frame, with the columns COLUMNS; frames that differ in exposure_s alone are a bracket
FOLDER/...            the frames: 16-bit grey PNG or TIFF, raw digital numbers, black level included

Frames of a bracket that cannot be of one image - the same file, or not as bright as their exposures say - are refused.

docs/lab.md has an example. Importing is repeatable: what is in the stream already is not read again.
"""

from __future__ import annotations

import csv
import itertools
import logging
import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from PIL import Image, UnidentifiedImageError
from pydantic import Field, model_validator

from hw.base.arrays import U16
from hw.base.config import NearbyFile, Strict, as_table, load_toml
from hw.base.errors import InputError
from hw.camera.bracket import Bracket
from hw.interface import Aim
from hw.record import Sensor
from pipeline.geometry.mesh_file import read_scan
from pipeline.geometry.nominal_rig import RigConfig
from pipeline.plan.plan import ImageAddress, Plan
from pipeline.records import write_capture_records
from pipeline.stream.layout import ImageMeta
from pipeline.stream.stream import StreamWriter

log = logging.getLogger(__name__)

COLUMNS = ("file", "kind", "camera", "angle_deg", "u", "v", "laser_nm", "exposure_s", "power_w", "time_s")
EXPOSURE_SHARE = 0.01  # by which an exposure may miss its power of two: as much is the radiance off
ANGLE_DEG = 0.01
WAVELENGTH_NM = 1.0
BRIGHT = 0.1  # of the range above the offset: pixels that show how two exposures go together
UNLIKE = 0.25  # by which their light may differ from what the exposures say; the nearest wrong exposure is half of it
OFFSET_DN = 2.0  # as far as an offset may be off


class CaptureDescription(Strict):
    """capture.toml."""

    format_version: Literal[1]
    scan: NearbyFile
    saturation_dn: Annotated[int, Field(ge=1, le=65535)]  # linear below this
    sensor: Annotated[Sensor, as_table(Sensor)]
    rig: RigConfig

    @model_validator(mode="after")
    def _fits_itself(self) -> Self:
        sensor, lasers = self.sensor, len(self.rig.lasers)
        if len(sensor.responsivity) != lasers:
            raise ValueError(
                f"sensor.responsivity has {len(sensor.responsivity)} of the {lasers} values that rig.lasers ask for: "
                "give one for each laser"
            )
        if self.saturation_dn > sensor.saturation_dn:
            raise ValueError(
                f"saturation_dn = {self.saturation_dn} is beyond what sensor.bits = {sensor.bits} can hold (allowed: "
                f"at most {sensor.saturation_dn})"
            )
        if sensor.offset_dn >= self.saturation_dn:
            raise ValueError(
                f"sensor.offset_dn = {sensor.offset_dn:g} is no less than saturation_dn = {self.saturation_dn}: "
                "nothing is left for light"
            )
        return self


@dataclass(frozen=True)
class Frame:
    """One line of the table. exponent: halvings of the longest exposure."""

    line: int
    file: Path
    exponent: int
    power_w: float
    time_s: float


Key = tuple[int, int, int, int, int]  # camera, angle, u, v, laser; a silhouette has u = v = laser = -1


def import_capture(folder: Path, out: Path, progress: Callable[[int, int], None] | None = None) -> Plan:
    """Write the stream and what the pipeline is told with it into `out`; the plan that the images make up.

    Raises: InputError, with the line of the table where there is one.
    """
    what = "a capture.toml (docs/lab.md, section 6, shows one)"
    described = load_toml(folder / "capture.toml", CaptureDescription, what)
    scan = bytes(read_scan(described.scan).export(file_type="ply"))
    table = folder / "images.csv"
    brackets = _read_table(table, described)
    plan = _plan(table, described.rig, brackets)
    sensor = described.sensor
    exponents = tuple(range(sensor.steps))
    bracket = Bracket(sensor.longest_exposure_s, exponents, sensor.bits, described.saturation_dn)
    with StreamWriter(out, plan) as stream:
        write_capture_records(out, scan, described.rig, sensor)
        for index in range(len(stream), len(plan)):
            address = plan.address(index)
            frames = brackets[_key(plan, address)]
            camera = described.rig.cameras[plan.camera_of(address.view)]
            pixels = _pixels(table, frames, (camera.height, camera.width), bracket)
            raw = bracket.merge(_agreeing(table, pixels, sensor, described.saturation_dn))
            stream.append(address, raw, _meta(plan, address, frames))
            if progress is not None:
                progress(index + 1, len(plan))
    return plan


# ---- the table


def _read_table(path: Path, described: CaptureDescription) -> dict[Key, list[Frame]]:
    """The frames of every image, by falling exposure."""
    brackets: dict[Key, list[Frame]] = {}
    seen: dict[Path, int] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file)
            missing = [name for name in COLUMNS if name not in (rows.fieldnames or ())]
            if missing:
                raise InputError(f"has no column {missing[0]!r}", file=path, allowed=", ".join(COLUMNS))
            for row in rows:
                key, frame = _row(path, rows.line_num, row, described)
                if (other := seen.setdefault(frame.file, frame.line)) != frame.line:
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


def _row(path: Path, line: int, row: dict[str, str], described: CaptureDescription) -> tuple[Key, Frame]:
    rig, sensor = described.rig, described.sensor

    def wrong(column: str, allowed: str) -> InputError:
        return InputError(f"line {line} cannot be used", file=path, key=column, value=row[column], allowed=allowed)

    def number(column: str, allowed: str) -> float:
        try:
            value = float(row[column])
        except (TypeError, ValueError):
            raise wrong(column, allowed) from None
        if not math.isfinite(value):
            raise wrong(column, allowed)
        return value

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
    return (camera, angle, u, v, laser), Frame(line, frame.file, exponent, power, frame.time_s)


def _nearest(value: float, choices: tuple[float, ...] | list[float], tolerance: float, period: float) -> int | None:
    """The choice that is meant."""
    away = [abs(math.remainder(value - choice, period)) for choice in choices]
    best = min(range(len(choices)), key=away.__getitem__)
    return best if away[best] <= tolerance else None


def _plan(path: Path, rig: RigConfig, brackets: dict[Key, list[Frame]]) -> Plan:
    """Spots in the order of the table, grouped by angle; every view must have all of its angle's, in all lasers."""
    order: dict[tuple[int, int, int], None] = dict.fromkeys(key[1:4] for key in brackets if key[4] >= 0)
    aims = tuple(Aim(*aim) for aim in sorted(order, key=lambda aim: aim[0]))  # stable
    angles = tuple(float(a) for a in np.deg2rad(rig.turntable_angles_deg))
    plan = Plan(tuple(camera.name for camera in rig.cameras), angles, aims, len(rig.lasers))
    missing = [address for address in plan.addresses() if _key(plan, address) not in brackets]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(plan)} images are missing, the first is {_words(rig, plan, missing[0])}",
            file=path,
            remedy="every camera needs, at every angle, a silhouette and all spots in all lasers; leave incomplete "
            "spots, cameras or angles out of images.csv and capture.toml",
        )
    return plan


def _key(plan: Plan, address: ImageAddress) -> Key:
    camera, angle = plan.camera_of(address.view), plan.angle_of(address.view)
    if address.kind == "silhouette":
        return (camera, angle, -1, -1, -1)
    aim = plan.spots[address.spot]
    return (camera, angle, aim.u, aim.v, address.laser)


def _words(rig: RigConfig, plan: Plan, address: ImageAddress) -> str:
    camera, angle, u, v, laser = _key(plan, address)
    place = f"camera {rig.cameras[camera].name}, {rig.turntable_angles_deg[angle]:g} deg"
    return place + (", silhouette" if laser < 0 else f", u {u}, v {v}, {rig.lasers[laser].wavelength_nm:g} nm")


def _meta(plan: Plan, address: ImageAddress, frames: list[Frame]) -> ImageMeta:
    """Power: the mean of the bracket's, by exposure; time: its last frame's."""
    angle = plan.angles_rad[plan.angle_of(address.view)]
    time_s = max(frame.time_s for frame in frames)
    if address.kind == "silhouette":
        return ImageMeta(time_s, 0.0, angle, -1, -1)
    aim, weights = plan.spots[address.spot], [2.0**-frame.exponent for frame in frames]
    power = float(np.average([frame.power_w for frame in frames], weights=weights))
    return ImageMeta(time_s, power, angle, aim.u, aim.v)


# ---- the frames


def _pixels(table: Path, frames: list[Frame], shape: tuple[int, int], bracket: Bracket) -> Iterator[tuple[Frame, U16]]:
    for frame in frames:
        yield frame, read_frame(frame.file, shape, bracket.full_scale_dn, f"line {frame.line} of {table}")


def _agreeing(
    table: Path, frames: Iterator[tuple[Frame, U16]], sensor: Sensor, saturation_dn: int
) -> Iterator[tuple[int, U16]]:
    """Frames of one image, by falling exposure, as (exponent, pixels). Raises: InputError where one is not as bright as
    the one before it lets expect from exposure and power.
    """
    before: tuple[Frame, U16] | None = None
    for frame, pixels in frames:
        if before is not None and not sensor.response:
            longer, shown = before
            ratio = 2.0 ** (longer.exponent - frame.exponent)
            ratio *= frame.power_w / longer.power_w if longer.power_w else 1.0
            charge = shown.astype(np.float64) - sensor.offset_dn
            used = (charge > BRIGHT * (saturation_dn - sensor.offset_dn)) & (shown < saturation_dn)
            expected = float(charge[used].sum()) * ratio
            found = float(pixels[used].sum(dtype=np.float64)) - sensor.offset_dn * int(used.sum())
            noise = np.sqrt(
                expected / sensor.gain_e_per_dn + used.sum() * (sensor.read_noise_e / sensor.gain_e_per_dn) ** 2
            )
            if abs(found - expected) > UNLIKE * expected + OFFSET_DN * used.sum() + 5 * noise:
                raise InputError(
                    f"lines {longer.line} and {frame.line} cannot be exposures of one image: the second should have "
                    f"{ratio:.3g} of the first's light and has {found / expected * ratio:.3g}",
                    file=table, key="exposure_s", remedy="correct file, exposure_s or power_w, or leave the frame out",
                )  # fmt: skip
        before = frame, pixels
        yield frame.exponent, pixels


def read_frame(path: Path, shape: tuple[int, int], full_scale_dn: int, where: str) -> U16:
    """(height, width) digital numbers of a 16-bit grey image; Raises: InputError for anything else."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # Pillow reads a damaged file as far as it gets
            with Image.open(path) as image:
                mode, pixels = image.mode, np.asarray(image)
    except FileNotFoundError as error:
        raise InputError(f"no such file ({where})", file=path, remedy="copy the frame there") from error
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError, UserWarning) as error:
        raise InputError(f"not a readable image ({error})", file=path, remedy="16-bit grey PNG or TIFF") from error
    if mode not in ("I;16", "I;16B", "I;16L", "I"):
        raise InputError("is not 16-bit grey", file=path, value=mode, allowed="16-bit grey PNG or TIFF")
    if pixels.shape != shape:
        problem = f"has {pixels.shape[1]} x {pixels.shape[0]} pixels"
        raise InputError(problem, file=path, allowed=f"the camera's {shape[1]} x {shape[0]}")
    if pixels.min() < 0 or pixels.max() > full_scale_dn:
        value, allowed = int(pixels.max() if pixels.max() > full_scale_dn else pixels.min()), f"0 to {full_scale_dn}"
        remedy = "correct sensor.bits, or shift the values down if the camera fills the upper bits"
        raise InputError("holds values beyond the sensor's", file=path, value=value, allowed=allowed, remedy=remedy)
    return pixels.astype(np.uint16)
