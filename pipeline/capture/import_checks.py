"""Frames, description, scan and silhouettes against each other, before an import stores anything."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import trimesh

from hw.base.arrays import U16
from hw.base.errors import InputError
from hw.interface import Aim
from hw.record import RawImage
from pipeline.capture.import_brackets import compare, require_agreement
from pipeline.capture.import_description import CaptureDescription
from pipeline.capture.import_frames import read_frame
from pipeline.capture.import_statistics import FrameStatistics, content_key, incomplete
from pipeline.capture.import_table import Frame, Key, key_of
from pipeline.capture.silhouettes import chosen_views, examine_silhouettes
from pipeline.capture.spot_places import Sighting, chosen_spots, examine_spots, sighting
from pipeline.geometry.nominal_rig import RigConfig
from pipeline.plan.plan import ImageAddress, Plan

LEAST_POWER = 0.01  # of rig.lasers.power_mw at the object: less is lost by no fibre


def require_consistent(
    file: Path,
    table: Path,
    described: CaptureDescription,
    scan: trimesh.Trimesh,
    brackets: dict[Key, list[Frame]],
    plan: Plan,
    report: Callable[[int], None],
) -> list[str]:
    """Read every frame; warnings of what is odd, one line each. file: capture.toml; report: images that were read.

    Raises: InputError where frames, capture.toml and images.csv contradict each other.
    """
    _require_outside(file, described.rig, scan)
    check = _FrameCheck(table, described)
    done = 0

    def image(address: ImageAddress) -> RawImage:
        nonlocal done
        raw = check.image(brackets[key_of(plan, address)], plan.camera_of(address.view))
        done += 1
        report(done)
        return raw

    addresses = sorted(plan.addresses(), key=lambda a: a.kind != "silhouette")  # stable: a wrong pose ends it early
    chosen = set(chosen_views(plan))
    silhouettes = [(a.view, image(a)) for a in addresses if a.kind == "silhouette" and a.view in chosen]
    _require_light("silhouette", [_lit(view, raw, described) for view, raw in silhouettes], table)
    fit = examine_silhouettes(silhouettes, described.known, described.rig, scan)
    if fit.decisive or fit.hopeless:
        raise InputError(fit.problem, file=table, remedy=fit.remedy)
    wanted, found, lit = set(chosen_spots(plan)), list[Sighting](), list[bool]()
    for address in addresses:
        if address.kind == "silhouette" and address.view in chosen:
            continue
        raw = image(address)
        if address in wanted:
            seen = sighting(address.view, plan.spots[address.spot], raw, described.known, address.laser)
            found += [] if seen is None or not fit.fits else [seen]
            lit.append(seen is not None)
    check.statistics.require_description(file)
    _require_light("spot", lit, table)
    spots = examine_spots(found, described.rig, scan)
    if spots.decisive:
        raise InputError(spots.problem, file=table, remedy=spots.remedy)
    lines = [*fit.warnings(), *spots.warnings()]
    return [*(f"{table}: {line}" for line in lines), *_weak_lasers(table, described.rig, brackets)]


def _require_outside(file: Path, rig: RigConfig, scan: trimesh.Trimesh) -> None:
    """Refuse cameras and projector inside the scan's box. Raises: InputError."""
    places = {f"rig.cameras[{k}]": camera.position_mm for k, camera in enumerate(rig.cameras)}
    for key, place in (places | {"rig.projector": rig.projector.position_mm}).items():
        if np.all((scan.bounds[0] < place) & (place < scan.bounds[1])):
            raise InputError("lies inside the scan", file=file, key=f"{key}.position_mm", value=tuple(place),
                             remedy="state it in mm, in the scan's frame")  # fmt: skip


def _lit(view: int, raw: RawImage, described: CaptureDescription) -> bool:
    return sighting(view, Aim(0, 0, 0), raw, described.known, 0) is not None


def _require_light(kind: str, lit: Sequence[bool], table: Path) -> None:
    """Raises: InputError where none of the images that were looked at shows anything."""
    if lit and not any(lit):
        remedy = "see that the frames are those of the table, and that lamp and gates were on"
        raise InputError(
            f"no {kind} shows any light beyond noise ({len(lit)} were looked at)", file=table, remedy=remedy
        )


class _FrameCheck:
    """All frames, one after the other, against each other."""

    def __init__(self, table: Path, described: CaptureDescription) -> None:
        self.table, self.described = table, described
        self.statistics = FrameStatistics(described.known, described.saturation_dn)
        self._lines: dict[bytes, int] = {}
        self._before: U16 | None = None

    def image(self, frames: list[Frame], camera: int) -> RawImage:
        """The record of an image, all of whose frames have been looked at. Raises: InputError."""
        pictures = [picture for _, picture in pictures_of(self.table, self.described, frames, camera)]
        for (a, longer), (b, shorter) in itertools.pairwise(zip(frames, pictures, strict=True)):
            if not self.described.sensor.response:
                pair = compare(a, longer, b, shorter, self.statistics.sensor, self.described.saturation_dn)
                require_agreement(pair, a, b, self.table)
                self.statistics.pairs.append(pair)
        for frame, picture in zip(frames, pictures, strict=True):
            self._single(frame, picture)
        return self.described.bracket.merge((f.exponent, p) for f, p in zip(frames, pictures, strict=True))

    def _single(self, frame: Frame, picture: U16) -> None:
        key = content_key(picture)
        if key is not None and (line := self._lines.setdefault(key, frame.line)) != frame.line:
            remedy = "correct one of them"
            raise InputError(
                f"lines {line} and {frame.line} show one picture, to the last digit", file=self.table, key="file",
                value=frame.file.name, remedy=remedy,
            )  # fmt: skip
        if (why := incomplete(picture, self._before, self.statistics)) is not None:
            problem, remedy = f"is no complete picture: it {why}", "take the frame again, or leave its line out"
            raise InputError(f"{problem} (line {frame.line} of {self.table})", file=frame.file, remedy=remedy)
        self.statistics.add(picture)
        self._before = picture


def pictures_of(
    table: Path, described: CaptureDescription, frames: list[Frame], camera: int
) -> Iterator[tuple[int, U16]]:
    """(exponent, pixels) of the frames of an image, by falling exposure. Raises: InputError as `read_frame`."""
    own = described.rig.cameras[camera]
    for frame in frames:
        where = f"line {frame.line} of {table}"
        shape = own.height, own.width
        yield frame.exponent, read_frame(frame.file, shape, described.bracket.full_scale_dn, where)


def _weak_lasers(table: Path, rig: RigConfig, brackets: dict[Key, list[Frame]]) -> list[str]:
    """Lasers of whose power hardly anything arrives, one line each."""
    out = []
    for number, laser in enumerate(rig.lasers):
        watts = [frame.power_w for key, frames in brackets.items() if key[4] == number for frame in frames]
        share = float(np.median(watts)) / (laser.power_mw * 1e-3) if watts else 1.0
        if share < LEAST_POWER:
            out.append(
                f"{table}: power_w is {100 * share:.2g} % of the laser's power at {laser.wavelength_nm:g} nm "
                f"(rig.lasers.power_mw = {laser.power_mw:g}). Remedy: state it in watts, or correct power_mw"
            )
    return out
