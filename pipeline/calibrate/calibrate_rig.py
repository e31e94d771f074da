"""The calibration of a captured rig, from its own images alone: lenses, white balance, poses, projector.

Reads CAPTURE/calibration/<camera>/ (boards and the white plate) and, from the capture itself, silhouettes and spots.
Every stage starts from the nominal rig and the tolerances of a set-up, and from nothing else of the actual rig.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from scipy.linalg import block_diag

from hw.base.arrays import F64, I64
from hw.base.errors import DiscoError
from hw.record import Sensor, to_radiance
from pipeline.calibrate.calibration import (
    Calibration,
    LaserCalibration,
    ProjectorCalibration,
    ScanCalibration,
    ViewCalibration,
    pair,
    triple,
)
from pipeline.calibrate.peaks import Peak, brightness, find_peak, footprint, seen
from pipeline.calibrate.photometric import with_places
from pipeline.calibrate.pose import PoseFit, fit_poses
from pipeline.calibrate.projector_fit import GATE, ProjectorFit, StepSize, refine, step_size, true_spots
from pipeline.calibrate.projector_prior import nominal_projector, with_pose_error
from pipeline.calibrate.response import Response
from pipeline.calibrate.target_images import CameraImages, measure_response, read_targets
from pipeline.geometry.camera import turn
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.nominal_rig import RigConfig
from pipeline.geometry.projector import TwoMirrorProjector
from pipeline.plan.plan import ImageAddress
from pipeline.plan.targets import FOLDER
from pipeline.stream.stream import CorruptImage, StreamReader

log = logging.getLogger(__name__)

FALSE_STEPS = 60.0  # a spot that a matrix misses by more is false
PATCH_MM = 10.0  # within which the object moves the peaks of spots alike
PLATE_SPOT_MM = 0.05  # how well a spot's place on the white plate is seen


@dataclass(frozen=True)
class RigMeasurement:
    """The calibration, and the figures of each of its stages."""

    calibration: Calibration
    cameras: tuple[CameraImages, ...]
    poses: PoseFit
    projector: ProjectorFit
    response: Response | None = None  # None: the camera is linear


def measure(capture: Path, rig: RigConfig, sensor: Sensor, mesh: trimesh.Trimesh) -> RigMeasurement:
    """All stages. `mesh`: the scan as it came, in mm. Raises: DiscoError where the images do not tell a part."""
    response = measure_response(capture, rig, sensor) if rig.sensor.response == "curved" else None
    if response is not None:
        sensor = replace(sensor, response=tuple(float(x) for x in response.exposure))
    cameras = [read_targets(capture / FOLDER / c.name, rig, i, sensor) for i, c in enumerate(rig.cameras)]
    whites = with_places([c.balance for c in cameras])
    cameras = [replace(camera, balance=white) for camera, white in zip(cameras, whites, strict=True)]
    angles = [float(a) for a in np.deg2rad(rig.turntable_angles_deg)]
    with StreamReader(capture) as stream:
        stream.require_complete()
        poses = measure_poses(stream, sensor, mesh, cameras, angles)
        mesh = poses.scan.moved(mesh)
        nominal, place = nominal_projector(rig, [c.lens for c in cameras], poses)
        size = plane_measurement(cameras, poses, nominal)
        fit = measure_projector(stream, rig, sensor, mesh, poses, size, nominal, place)
        watts = mean_power(stream)
    for text in poses.ambiguity:
        log.warning("the silhouettes leave open: %s", text)
    return RigMeasurement(assemble(rig, sensor, cameras, poses, fit, watts), tuple(cameras), poses, fit, response)


def measure_poses(
    stream: StreamReader,
    sensor: Sensor,
    mesh: trimesh.Trimesh,
    cameras: Sequence[CameraImages],
    angles: Sequence[float],
) -> PoseFit:
    """From the silhouette image of every view. Raises: DiscoError as `fit_poses`, CorruptImage."""
    images = []
    for view in range(stream.plan.views):
        raw = stream.read(ImageAddress(view, "silhouette"))
        images.append(to_radiance(raw, sensor, 0).radiance / cameras[stream.plan.camera_of(view)].lens.illumination())
    lenses = [c.lens.seen_from(turn(angles[0])) for c in cameras]
    return fit_poses(images, mesh, lenses, angles, [c.intrinsics.covariance for c in cameras])


def plane_measurement(cameras: Sequence[CameraImages], poses: PoseFit, projector: TwoMirrorProjector) -> StepSize:
    """The projector's step size from the spots on the white plate of the camera that sees most of them."""
    best = max(range(len(cameras)), key=lambda c: len(cameras[c].plate_points))
    here, view = cameras[best], best * len(poses.turns)
    to_projector = projector.pose @ np.linalg.inv(poses.views[view].pose)
    local = here.plate_points @ to_projector[:3, :3].T + to_projector[:3, 3]
    turned = block_diag(to_projector[:3, :3], to_projector[:3, :3])
    motion = turned @ poses.covariance(view) @ turned.T
    return step_size(local, here.plate_steps, motion, projector, PLATE_SPOT_MM)


@dataclass(frozen=True)
class Sightings:
    """Peaks of one laser in all images that could be read. view, spot: (N,); power: (N,) W."""

    view: I64
    spot: I64
    power: F64
    peaks: tuple[Peak, ...]


def find_peaks(stream: StreamReader, sensor: Sensor, laser: int) -> Sightings:
    """Every spot image of a laser: where its brightest place lies."""
    plan = stream.plan
    wanted = [a for a in plan.addresses() if a.kind == "spot" and a.laser == laser]
    view, spot, power, peaks = [], [], [], []
    for address, raw in zip(wanted, stream.read_many(wanted), strict=True):
        watts = stream.meta(address).photodiode_w
        if not isinstance(raw, CorruptImage) and watts > 0:
            view.append(address.view)
            spot.append(address.spot)
            power.append(watts)
            peaks.append(find_peak(to_radiance(raw, sensor, laser).radiance))
    return Sightings(np.array(view, np.int64), np.array(spot, np.int64), np.array(power), tuple(peaks))


def measure_projector(
    stream: StreamReader,
    rig: RigConfig,
    sensor: Sensor,
    mesh: trimesh.Trimesh,
    poses: PoseFit,
    size: StepSize,
    nominal: TwoMirrorProjector,
    place_error: F64,
) -> ProjectorFit:
    """From the spots on the object, in the object frame at the first angle. All cameras' sightings count.

    nominal: in that frame, place_error: (6, 6) covariance of its pose. Raises: DiscoError where no camera sees any.
    """
    plan, surface = stream.plan, RayMesh.of(mesh)
    found = find_peaks(stream, sensor, plan.lasers // 2)
    bright = brightness(found.peaks, found.power)
    places, normals, eyes, spots, patches, views = [], [], [], [], [], []
    for view in range(plan.views):
        camera, back = poses.views[view], poses.turns[plan.angle_of(view)]
        here = np.flatnonzero(found.view == view)
        peaks = [found.peaks[k] for k in here]
        beam_px = rig.projector.beam_diameter_mm * float(camera.focal.mean()) / float(camera.pose[2, 3])
        good = seen(peaks, found.power[here], beam_px, bright)
        pixels = np.array([p.pixel for p, g in zip(peaks, good, strict=True) if g]).reshape(-1, 2)
        origin, way = camera.rays(pixels)
        hit = surface.first_hit(origin, way)
        which = np.flatnonzero(hit.triangle >= 0)
        if not len(which):
            continue
        face, weights = hit.triangle[which], hit.barycentric[which]
        local = surface.points(face, weights)
        places.append(local @ back[:3, :3].T + back[:3, 3])
        normals.append(surface.smooth_normals(face, weights) @ back[:3, :3].T)
        eyes.append(-way[which] @ back[:3, :3].T)
        spots.append(found.spot[here][good][which])
        views.append(np.full(len(which), view))
        cell = np.floor(local / PATCH_MM).astype(np.int64) + 500
        patches.append(((plan.angle_of(view) * 1000 + cell[:, 0]) * 1000 + cell[:, 1]) * 1000 + cell[:, 2])
    if not places:
        raise DiscoError("no camera sees any spot. Remedy: check that the laser reaches the object")
    place, normal, eye = (np.asarray(np.concatenate(x), np.float64) for x in (places, normals, eyes))
    spot = np.concatenate(spots)
    steps = np.array([(plan.spots[s].u, plan.spots[s].v) for s in spot], float)
    of_angle = np.array([plan.spots[s].angle for s in spot])
    group = np.unique(np.concatenate(patches), return_inverse=True)[1]
    true = true_spots(place, steps, FALSE_STEPS, np.random.default_rng(0))
    fit = refine(nominal, place[true], steps[true], normal[true], eye[true], size, group[true], place_error)
    # A matrix from a few noisy spots is a coarse sieve; the model itself says better which sightings are true. It also
    # says how the beam lies on the surface, and so where the light's centroid is beside the axis.
    origin, way = fit.projector.rays(steps)
    turns = np.stack(poses.turns)[of_angle]
    back_origin = np.einsum("nji,nj->ni", turns[:, :3, :3], origin - turns[:, :3, 3])
    back_way, back_eye = (np.einsum("nji,nj->ni", turns[:, :3, :3], x) for x in (way, eye))
    axis, centroid, whole = footprint(mesh, back_origin, back_way, back_eye, rig.projector.beam_diameter_mm / 2)
    place = place - np.where(whole[:, None], np.einsum("nij,nj->ni", turns[:, :3, :3], centroid - axis), 0.0)
    true = whole & (np.linalg.norm(fit.misses(place, steps, normal, eye), axis=1) < GATE * fit.rms_mm)
    log.info("projector: %d of %d sightings of %d images agree", int(true.sum()), len(spot), len(found.peaks))
    fit = refine(nominal, place[true], steps[true], normal[true], eye[true], size, group[true], place_error)
    fit = replace(fit, false=~true, images=len(found.peaks), sightings=len(spot))
    return with_pose_error(fit, poses, int(np.bincount(np.concatenate(views)[true]).argmax()))


def mean_power(stream: StreamReader) -> F64:
    """(L,) mean of the photodiode over the capture's spot images, W."""
    total, count = np.zeros(stream.plan.lasers), np.zeros(stream.plan.lasers)
    for address in stream.plan.addresses():
        if address.kind == "spot":
            total[address.laser] += stream.meta(address).photodiode_w
            count[address.laser] += 1
    return np.asarray(total / np.maximum(count, 1))


def assemble(
    rig: RigConfig, sensor: Sensor, cameras: Sequence[CameraImages], poses: PoseFit, fit: ProjectorFit, watts: F64
) -> Calibration:
    """The calibration file's content."""
    angles = [float(a) for a in np.deg2rad(rig.turntable_angles_deg)]
    views = []
    for v, camera in enumerate(poses.views):
        own, config = cameras[v // len(angles)], rig.cameras[v // len(angles)]
        spread = np.sqrt(np.diag(own.intrinsics.covariance))
        views.append(
            ViewCalibration.of(
                config.name,
                angles[v % len(angles)],
                camera,
                focal_error_px=float(spread[0]),
                centre_error_px=pair(spread[1:3]),
                rotation_error_rad=triple(poses.rotation[v]),
                translation_error_mm=triple(poses.translation[v]),
                radiance_factor=tuple(float(x) for x in own.balance.factor),
                radiance_factor_error=tuple(float(x) for x in own.balance.error),
            )
        )
    spread = np.sqrt(np.diag(fit.covariance))
    projectors = [
        ProjectorCalibration.of(
            angle,
            fit.projector.seen_from(turned),
            rig.projector.beam_diameter_mm,
            rotation_error_rad=triple(spread[:3]),
            translation_error_mm=triple(spread[3:6]),
            full_angle_error_rad=pair(spread[6:8]),
        )
        for angle, turned in zip(angles, poses.turns, strict=True)
    ]
    scatter = np.max([c.balance.scatter for c in cameras], axis=0)
    lasers = tuple(
        LaserCalibration(wavelength_nm=config.wavelength_nm, power_w=float(w), power_error_w=float(w * s))
        for config, w, s in zip(rig.lasers, watts, scatter, strict=True)
    )
    scan = None
    if not poses.scan.because:
        move, error = (tuple(float(x) for x in values) for values in (poses.scan.displacement, poses.scan.error))
        scan = ScanCalibration(displacement_mm=move, error_mm=error)
    return Calibration(
        source="measured", views=tuple(views), projectors=tuple(projectors), lasers=lasers, sensor=sensor, scan=scan
    )
