"""Slips on purpose in the poses, the turntable's axis and the scan.

The stage's own score, or its z-score, sees each of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh
from axis_truth import true_axis
from calibrate_slips import F64, Patch, Slip, require_seen
from calibrate_twin import (
    Silhouettes,
    faulty_rig,
    floodlit,
    photograph,
    silhouettes,
    world,
)
from scipy.spatial.transform import Rotation

from disco_twin.object.scanner import scan_points
from pipeline.calibrate import outline, pose
from pipeline.calibrate.pose import fit_poses
from pipeline.geometry.camera import PinholeCamera, turn
from pipeline.geometry.surface_from_points import _outside, reconstruct_surface


@cache
def one_camera() -> Silhouettes:
    return silhouettes(4, world().scan, faulty_rig().model_copy(update={"cameras": faulty_rig().cameras[:1]}))


def pose_score(
    start: Callable[[PinholeCamera], PinholeCamera] | None = None, mesh: trimesh.Trimesh | None = None
) -> float:
    """rms of the edges in pixels."""
    seen = one_camera()
    lens = start(seen.lenses[0]) if start else seen.lenses[0]
    return fit_poses(seen.images[:3], mesh or world().scan, [lens], seen.angles).residual_px


def transposed(lens: PinholeCamera) -> PinholeCamera:
    matrix = lens.pose.copy()
    matrix[:3, :3] = matrix[:3, :3].T
    return replace(lens, pose=matrix)


def wrong_way_round(patch: Patch) -> None:
    patch.setattr(pose, "turn", lambda angle: turn(-angle))


def degrees(patch: Patch) -> None:
    patch.setattr(pose, "turn", lambda angle: turn(np.rad2deg(angle)))


def edges_upside_down(patch: Patch) -> None:
    real = outline.edges_along
    patch.setattr(pose, "edges_along", lambda image, pixel, normal: real(image, pixel, -normal))


POSE: dict[str, tuple[float, Slip | None, Callable[[PinholeCamera], PinholeCamera] | None, Callable[[F64], F64] | None]]
POSE = {
    "pose transposed": (3, None, transposed, None),
    "image mirrored": (3, None, lambda lens: replace(lens, focal=lens.focal * [-1, 1]), None),
    "axis turned the wrong way": (3, wrong_way_round, None, None),
    "axis in degrees": (3, degrees, None, None),
    "normals inwards": (3, edges_upside_down, None, None),
    "scan: axes swapped": (3, None, None, lambda v: v[:, [1, 0, 2]] * [1, -1, 1] * [1, 1, -1]),
    "scan: one per cent too large": (1.5, None, None, lambda v: v * [1.01, 1.01, 1.0]),
    "scan: half a millimetre beside its axis": (1.5, None, None, lambda v: v + 0.5 * np.sign(v) * [1, 0, 0]),
}


@pytest.fixture(scope="module")
def good_pose() -> float:
    return pose_score()


@pytest.mark.parametrize("name", POSE)
def test_pose_axis_and_scan_slips_show(name: str, good_pose: float, monkeypatch: Patch) -> None:
    assert good_pose < 0.06
    factor, slip, start, change = POSE[name]
    mesh = None
    if change is not None:
        mesh = trimesh.Trimesh(change(np.asarray(world().scan.vertices)), world().scan.faces, process=False)
    if slip is not None:
        slip(monkeypatch)
    require_seen(lambda: pose_score(start, mesh), good_pose, factor)


def test_half_a_pixel_shows_in_the_z_scores() -> None:
    """A pose can follow half a pixel without a trace in its edges: its own figures then are off by many sigmas."""
    seen, mesh = one_camera(), world().scan

    def score(centre: float) -> float:
        lens = replace(seen.lenses[0], centre=seen.lenses[0].centre + centre)
        found = fit_poses(seen.images[:3], mesh, [lens], seen.angles)
        across = found.views[0].pose[:2, 3] - seen.truth[0].pose[:2, 3]
        return float(np.abs(across / found.translation[0, :2]).max())

    good = max(score(0.0), 1.0)
    assert good < 4
    require_seen(lambda: score(0.5), good, 20)


def test_slips_of_the_axis_show_in_its_z_scores() -> None:
    """A turntable that leans by two degrees: found; with swapped axes, the wrong sign or in degrees it is not."""
    rig = faulty_rig()
    mesh, camera = world().object.mesh, PinholeCamera.from_config(rig.cameras[0])
    lean = np.eye(4)
    lean[:3, :3] = Rotation.from_rotvec(np.deg2rad([1.5, -0.6, 0.0])).as_matrix()
    angles = [float(a) for a in np.deg2rad(rig.turntable_angles_deg)]
    turns = [lean @ turn(a) @ np.linalg.inv(lean) for a in angles]
    images = [photograph(rig, camera.seen_from(t), floodlit(mesh, camera.seen_from(t)), k) for k, t in enumerate(turns)]
    found, (tilt, _) = fit_poses(images, mesh, [camera], angles), true_axis(turns)

    def score(axis: F64) -> float:
        return float(np.abs((axis - tilt) / found.axis_error[:2]).max())

    good = max(score(found.axis[:2]), 1.0)
    assert good < 4
    for slip in (found.axis[1::-1], -found.axis[:2], np.rad2deg(found.axis[:2])):
        assert score(slip) > 5 * good


def surface_score(change: Callable[[F64, F64], tuple[F64, F64]]) -> float:
    """mm, rms distance of points of the object from the mesh."""
    points, normals = scan_points(world().object.mesh, 3)
    found = reconstruct_surface(*change(points, normals), 800).mesh
    return float(np.sqrt((_outside(found, np.asarray(world().object.mesh.vertices)[::40]) ** 2).mean()))


@pytest.mark.parametrize("name", ["normals' axes swapped", "half a millimetre deep"])
def test_scan_slips_show(name: str) -> None:
    good = surface_score(lambda p, n: (p, n))
    assert good < 0.2
    change: dict[str, Callable[[F64, F64], tuple[F64, F64]]] = {
        "normals' axes swapped": lambda p, n: (p, n[:, [1, 2, 0]]),
        "half a millimetre deep": lambda p, n: (p - 0.5 * n, n),
    }
    require_seen(lambda: surface_score(change[name]), good, 2)
