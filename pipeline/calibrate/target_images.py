"""What each camera's own images of boards and of the white plate say: its lens, its white balance, its response."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hw.base.arrays import F64, U16
from hw.base.config import read_json
from hw.base.errors import DiscoError, InputError
from hw.record import Sensor, to_radiance
from pipeline.calibrate.intrinsics import Intrinsics, board_pose, find_corners, fit_intrinsics
from pipeline.calibrate.peaks import find_peak, seen
from pipeline.calibrate.photometric import WhiteBalance, balance, pixel_areas
from pipeline.calibrate.response import Response, fit_response
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.nominal_rig import CameraConfig, RigConfig
from pipeline.plan.plan import ImageAddress
from pipeline.plan.targets import BRACKET, FOLDER, TARGETS, Targets
from pipeline.stream.stream import StreamReader

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CameraImages:
    """What one camera's target capture says."""

    lens: PinholeCamera  # nominal place, measured lens
    intrinsics: Intrinsics
    balance: WhiteBalance
    plate_points: F64  # (N, 3) mm, spots on the white plate in the camera's frame
    plate_steps: F64  # (N, 2)


def has_targets(capture: Path, rig: RigConfig) -> bool:
    """Whether calibration images of every camera lie beside the capture."""
    return all((capture / FOLDER / c.name / TARGETS).is_file() for c in rig.cameras)


def measure_response(capture: Path, rig: RigConfig, sensor: Sensor) -> Response:
    """From every camera's bracket of a board; the cameras are of one make and share one response.

    Raises: InputError where the brackets differ, or do not tell a response.
    """
    images: list[list[U16]] = []
    for camera in rig.cameras:
        with StreamReader(capture / FOLDER / camera.name / BRACKET) as stream:
            stream.require_complete()
            images.append([stream.read(index).charge for index in range(len(stream))])
        if len(images[-1]) != len(images[0]):
            first = rig.cameras[0].name
            raise InputError(
                f"the bracket has {len(images[-1])} exposures, that of camera {first} has {len(images[0])}",
                file=capture / FOLDER / camera.name / BRACKET,
                remedy="take the bracket of every camera with the same exposures: they share one response",
            )
    seconds = [sensor.longest_exposure_s * 2.0**-k for k in range(len(images[0]))]
    together = [np.concatenate([np.ravel(i) for i in same]) for same in zip(*images, strict=True)]
    return fit_response(together, seconds, sensor)


def read_targets(folder: Path, rig: RigConfig, camera: int, sensor: Sensor) -> CameraImages:
    """Lens and white balance of one camera. Raises: InputError, DiscoError where the targets do not tell them."""
    targets = read_json(folder / TARGETS, Targets, "take the calibration images again")
    nominal, board = PinholeCamera.from_config(rig.cameras[camera]), targets.corners()
    with StreamReader(folder) as stream:
        stream.require_complete()
        corners: dict[int, F64 | None] = {}
        for i, place in enumerate(targets.placements):
            if place.kind == "board":
                raw = stream.read(ImageAddress(i, "silhouette"))
                corners[i] = find_corners(to_radiance(raw, sensor, 0).radiance, board)
        found = fit_intrinsics(list(corners.values()), board, nominal)
        lens = found.lens(nominal)
        mounts = {targets.placements[i].mount: c for i, c in corners.items() if c is not None}
        poses = {
            i: board_pose(mounts[p.mount], board, lens)
            for i, p in enumerate(targets.placements)
            if p.kind == "white" and p.mount in mounts
        }
        if not poses:
            raise DiscoError(
                f"{folder}: no white plate's place is known. Remedy: photograph the board in the same mount"
            )
        white, points, steps = _plates(stream, targets, sensor, lens, poses, rig)
    return CameraImages(lens, found, white, points, steps)


def _plates(
    stream: StreamReader, targets: Targets, sensor: Sensor, lens: PinholeCamera, poses: dict[int, F64], rig: RigConfig
) -> tuple[WhiteBalance, F64, F64]:
    """White balance, and the spots' (N, 3) places in the camera's frame with their (N, 2) steps."""
    plan, lasers = stream.plan, stream.plan.lasers
    gain = 1.0 / lens.illumination()
    light: list[list[float]] = []
    reading: list[list[float]] = []
    place, points, steps = [], [], []
    dark = 0
    beam_px = rig.projector.beam_diameter_mm * float(lens.focal.mean()) / next(iter(poses.values()))[2, 3]
    config = rig.cameras[[c.name for c in rig.cameras].index(targets.camera)]
    for i, pose in poses.items():
        area, lit = pixel_areas(lens, pose), _same_side(config, rig, np.array(targets.placements[i].pose))
        share = np.array(targets.reflected if lit else targets.transmitted)
        for spot in plan.spots_at(i):
            sums, watts, peaks = [], [], []
            for laser in range(lasers):
                address = ImageAddress(i, "spot", spot, laser)
                image = to_radiance(stream.read(address), sensor, laser)
                radiance = image.radiance * gain
                sums.append(float((radiance * area).sum(dtype=np.float64)) / share[laser])
                watts.append(stream.meta(address).photodiode_w)
                peaks.append(find_peak(radiance))
            if not np.all(np.array(watts) > 0):  # a photodiode that reads nothing, or no number
                dark += 1
                continue
            if any(p.at_border for p in peaks) or not seen(peaks, np.array(watts), beam_px, 0.0).any():
                continue
            light.append(sums)
            reading.append(watts)
            place.append(targets.placements[i].mount)
            points.append(_on_plane(lens, np.mean([p.pixel for p in peaks], axis=0), pose))
            steps.append((plan.spots[spot].u, plan.spots[spot].v))
    if dark:
        log.warning("%s: %d spots on the white plate are left out: the photodiode read nothing", targets.camera, dark)
    if len(points) < 4:
        why = f" (in {dark} of them the photodiode read nothing)" if dark else ""
        remedy = "check the lasers and the photodiode" if dark else "check the plate's place"
        raise DiscoError(f"{targets.camera}: the white plate's spots are not seen{why}. Remedy: {remedy}")
    if len(set(place)) == 1:
        log.warning(
            "%s: the white plate was seen in one place only: by how much its places differ is assumed, not measured. "
            "Remedy: photograph it, and the board in the same mount, in a second place",
            targets.camera,
        )
    white = balance(np.array(light).T, np.array(reading).T, np.ones(lasers), np.array(place))
    return white, np.array(points), np.array(steps, float)


def _same_side(config: CameraConfig, rig: RigConfig, pose: F64) -> bool:
    """Whether the camera sees the plate's lit side (nominally)."""
    to_camera = np.subtract(config.position_mm, pose[:3, 3])
    to_laser = np.subtract(rig.projector.position_mm, pose[:3, 3])
    return bool((to_camera @ pose[:3, 2]) * (to_laser @ pose[:3, 2]) > 0)


def _on_plane(lens: PinholeCamera, pixel: F64, pose: F64) -> F64:
    """(3,) where a pixel's ray meets the plane z = 0 of a (4, 4) plane -> camera; camera's frame."""
    ray = lens.ahead(pixel[None])[0]
    return np.asarray(ray * (pose[:3, 3] @ pose[:3, 2]) / (ray @ pose[:3, 2]))
