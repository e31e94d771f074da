"""Error against time of the estimators of a calibration, each on images whose truth is known.

The response of a curved camera by the pixels looked at (and OpenCV's, after Debevec and Malik, which sees eight bits),
intrinsics by the number of boards, poses by the number of refining steps (and the thesis's XOR search, by its number of
evaluations), the projector by the number of spots. Boards and silhouettes are ray-cast, without the renderer.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from trimesh.ray.ray_pyembree import RayMeshIntersector

from disco_twin.camera.lars3 import Lars3, lars3_sensor
from disco_twin.camera.sensor import gamma_curve
from disco_twin.camera.targets import TargetSource
from disco_twin.faults.actual_rig import actual_rig
from disco_twin.object.shapes import pebble
from disco_twin.scene.rig_schema import FaultsConfig, TwinRigConfig
from disco_twin.scene.shape_schema import Pebble
from hw.record import to_radiance
from pipeline.calibrate import pose as pose_module
from pipeline.calibrate.intrinsics import find_corners, fit_intrinsics
from pipeline.calibrate.projector_fit import refine, true_spots
from pipeline.calibrate.response import TABLE, fit_response
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.nominal_rig import CameraConfig, ProjectorConfig
from pipeline.geometry.projector import TwoMirrorProjector
from pipeline.geometry.silhouette import mesh_mask, object_mask
from pipeline.plan.targets import make_bracket, make_targets

F64 = NDArray[np.float64]
SEED = 5


def rig_config() -> TwinRigConfig:
    """The rig of the quick scene, one camera, one turntable angle, off its nominal place."""
    camera = CameraConfig(
        name="front",
        position_mm=(390.0, -120.0, 190.0),
        width=192,
        height=124,
        focal_length_mm=62.0,
        pixel_pitch_um=44.0,
    )
    projector = ProjectorConfig(position_mm=(590.0, 60.0, 110.0), full_angle_deg=6.0)
    return TwinRigConfig(cameras=(camera,), projector=projector, faults=FaultsConfig(deviation=True))


def timed(work: Callable[[], Any], repetitions: int) -> tuple[Any, dict[str, float]]:
    """The result, and {seconds, seconds_min, seconds_max}, the first the median."""
    seconds, result = [], None
    for _ in range(repetitions):
        start = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - start)
    return result, {
        "seconds": statistics.median(seconds),
        "seconds_min": min(seconds),
        "seconds_max": max(seconds),
    }


def intrinsics(rig: TwinRigConfig, counts: Sequence[int], repetitions: int) -> list[dict[str, Any]]:
    """Error: of the focal length, as a share."""
    actual, sensor = actual_rig(rig, SEED), lars3_sensor(rig)
    targets, _ = make_targets(rig, 0)
    lens, optics = actual.cameras[0], Lars3.of(rig, actual.cameras[0])
    source = TargetSource(targets, lens, actual, 1.0)
    images = [
        to_radiance(optics.expose(source.silhouette(0, i), 0, np.random.default_rng(i)), sensor, 0).radiance
        for i, p in enumerate(targets.placements)
        if p.kind == "board"
    ]
    board, nominal, points = targets.corners(), PinholeCamera.from_config(rig.cameras[0]), []
    for count in counts:
        found, took = timed(
            lambda n=count: fit_intrinsics([find_corners(i, board) for i in images[-n:]], board, nominal),  # type: ignore[misc]
            repetitions,
        )
        error = abs(float(found.values[0] / lens.focal[0]) - 1)
        settings = {"boards": count, "reprojection_px": found.reprojection_px}
        points.append(took | {"error": error, "settings": settings})
    return points


def responses(
    rig: TwinRigConfig, strides: Sequence[int], repetitions: int
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Error: of the exposure that a digital number stands for, as a share, rms from a fiftieth of the range on.

    OpenCV's scale is its own: it is set to agree on the whole.
    """
    rig = rig.model_copy(update={"sensor": rig.sensor.model_copy(update={"response": "curved"})})
    actual, sensor = actual_rig(rig, SEED), lars3_sensor(rig)
    targets, plan = make_bracket(rig, 0)
    optics = Lars3.of(rig, actual.cameras[0])
    board = TargetSource(targets, actual.cameras[0], actual, 1.0).silhouette(0, 0)
    steps = range(len(plan.angles_rad))
    images = [optics.expose(board, 0, np.random.default_rng(k), k).charge for k in steps]
    seconds, knots = [2.0**-k for k in steps], np.linspace(0, 1, TABLE)[TABLE // 50 :]
    dense = np.linspace(0, 1, 100_001)
    truth = np.interp(knots, gamma_curve(dense), dense)
    ours, theirs = [], []
    for stride in strides:
        some = [image[:, ::stride] for image in images]
        found, took = timed(lambda some=some: fit_response(some, seconds, sensor), repetitions)  # type: ignore[misc]
        off = found.exposure[TABLE // 50 :] / truth - 1
        settings = {"pixels": some[0].size, "stated": float(np.median(found.error[5:-1] / found.exposure[5:-1]))}
        ours.append(took | {"error": float(np.sqrt((off**2).mean())), "settings": settings})
    stack = [np.repeat((i >> 4).astype(np.uint8)[:, :, None], 3, axis=2) for i in images]
    numbers = knots * (sensor.saturation_dn - sensor.offset_dn) + sensor.offset_dn
    for samples in (70, 200):
        solver = cv2.createCalibrateDebevec(samples=samples, lambda_=20.0, random=False)
        curve, took = timed(lambda s=solver: s.process(stack, np.asarray(seconds, np.float32)), repetitions)  # type: ignore[misc]
        ratio = np.interp(numbers, 16.0 * np.arange(256) + 7.5, np.asarray(curve, np.float64)[:, 0, 0]) / truth
        off = ratio / np.exp(np.log(ratio).mean()) - 1
        theirs.append(took | {"error": float(np.sqrt((off**2).mean())), "settings": {"pixels": samples}})
    return ours, theirs


def silhouette(mesh: trimesh.Trimesh, camera: PinholeCamera) -> NDArray[np.float32]:
    """(H, W) radiance of the floodlit mesh."""
    s = 4
    origins, directions = camera.rays(camera.pixel_centres(s))
    face = RayMeshIntersector(mesh).intersects_first(origins, directions)
    shade = np.where(face >= 0, 0.3 + 0.7 * np.abs((mesh.face_normals[face] * directions).sum(axis=1)), 0.0) * 2e-5
    return np.asarray(shade.reshape(camera.height, s, camera.width, s).mean(axis=(1, 3)), np.float32)


def poses(
    rig: TwinRigConfig, mesh: trimesh.Trimesh, steps: Sequence[int], xor: Sequence[int], repetitions: int
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Errors in mm: of the object's vertices before the camera, root mean square, from 5 mm and 5 degrees off."""
    actual, sensor = actual_rig(rig, SEED), lars3_sensor(rig)
    truth = actual.camera(0, 0)
    raw = Lars3.of(rig, truth).expose(silhouette(mesh, truth), 0, np.random.default_rng(0))
    image = to_radiance(raw, sensor, 0).radiance
    start_pose = truth.pose.copy()
    turned = Rotation.from_rotvec(np.deg2rad(5) * np.array([0.6, -0.64, 0.48])).as_matrix()
    start_pose[:3, :3] = turned @ truth.pose[:3, :3]
    start_pose[:3, 3] += [3.0, -2.0, 3.5]
    start = replace(truth, pose=start_pose)

    def error(camera: PinholeCamera) -> float:
        both = [mesh.vertices @ c.pose[:3, :3].T + c.pose[:3, 3] for c in (camera, truth)]
        return float(np.sqrt(((both[0] - both[1]) ** 2).sum(axis=1).mean()))

    ours, theirs = [], []
    kept = pose_module.FINE_STEPS
    for count in steps:
        pose_module.FINE_STEPS = count
        found, took = timed(lambda: pose_module.fit_poses([image], mesh, [start], [0.0]), repetitions)
        ours.append(took | {"error": error(found.views[0]), "settings": {"steps": count}})
    pose_module.FINE_STEPS = kept
    for count in xor:
        found, took = timed(lambda n=count: xor_search(image, mesh, start, n), 1)  # type: ignore[misc]
        theirs.append(took | {"error": error(found), "settings": {"evaluations": count}})
    return ours, theirs


def xor_search(
    image: NDArray[np.floating], mesh: trimesh.Trimesh, start: PinholeCamera, evaluations: int
) -> PinholeCamera:
    """The thesis's registration: downhill simplex on the number of pixels in which the silhouettes differ."""
    mask = object_mask(image)

    def moved(x: F64) -> PinholeCamera:
        pose = start.pose.copy()
        pose[:3, :3] = Rotation.from_rotvec(np.deg2rad(x[:3])).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += x[3:]
        return replace(start, pose=pose)

    simplex = np.vstack([np.zeros(6), 4.0 * np.eye(6)])
    options: Any = {"maxfev": evaluations, "initial_simplex": simplex, "xatol": 1e-4, "fatol": 0.1}

    def mismatch(x: Any) -> float:
        return float((mesh_mask(mesh, moved(x)) ^ mask).sum())

    nowhere: Any = np.zeros(6)
    best = minimize(mismatch, nowhere, method="Nelder-Mead", options=options)
    return moved(best.x)


def projectors(
    rig: TwinRigConfig, mesh: trimesh.Trimesh, counts: Sequence[int], repetitions: int
) -> list[dict[str, Any]]:
    """Error in mm of predicted spots on the surface, root mean square; every fifth spot is false."""
    actual, rng = actual_rig(rig, SEED).projector, np.random.default_rng(SEED)
    nominal, points = TwoMirrorProjector.from_config(rig.projector), []
    for count in counts:
        steps = np.rint(rng.uniform(1200, 2900, (4 * count, 2)))
        origin, way = actual.rays(steps)
        place, ray, face = RayMeshIntersector(mesh).intersects_location(origin, way, multiple_hits=False)
        place, steps, way, normal = place[:count], steps[ray][:count], way[ray][:count], mesh.face_normals[face][:count]
        seen = place + 0.05 * rng.standard_normal(place.shape)
        seen[::5] += 8 * rng.standard_normal(seen[::5].shape)

        def fit(seen: F64 = seen, steps: F64 = steps, normal: F64 = normal, way: F64 = way) -> TwoMirrorProjector:
            true = true_spots(seen, steps, 40.0, np.random.default_rng(0))
            return refine(nominal, seen[true], steps[true], normal[true], -way[true]).projector

        found, took = timed(fit, repetitions)
        origin, there = found.rays(steps)
        along = ((place - origin) * normal).sum(axis=1) / (there * normal).sum(axis=1)
        miss = np.linalg.norm(origin + along[:, None] * there - place, axis=1)
        points.append(took | {"error": float(np.sqrt((miss**2).mean())), "settings": {"spots": len(place)}})
    return points


def run(quick: bool = False) -> dict[str, Any]:
    """Curves {name, points: [{seconds, seconds_min, seconds_max, error, settings}]}."""
    rig, mesh = rig_config(), pebble(Pebble(kind="pebble", size_mm=(40.0, 36.0, 32.0)))
    repetitions = 1 if quick else 3
    ours, theirs = poses(
        rig, mesh, (2, 3) if quick else (2, 3, 5, 8), (100,) if quick else (100, 300, 1000), repetitions
    )
    response, debevec = responses(rig, (4,) if quick else (4, 2, 1), repetitions)
    curves = [
        {"name": "response", "points": response},
        {"name": "response, OpenCV", "points": debevec},
        {"name": "focal length", "points": intrinsics(rig, (8,) if quick else (6, 12, 24), repetitions)},
        {"name": "pose, edges", "points": ours},
        {"name": "pose, XOR", "points": theirs},
        {
            "name": "projector",
            "points": projectors(rig, mesh, (40, 100) if quick else (40, 100, 300, 1000), repetitions),
        },
    ]
    return {"name": "calibrate", "quick": quick, "vertices": len(mesh.vertices), "curves": curves}
