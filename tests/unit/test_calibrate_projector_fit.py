"""The projector from spots: DLT, false spots, coplanar spots, the two-mirror fit, and that a broken stage shows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from calibrate_twin import SHIFT, faulty_rig, shifted, world
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from trimesh.ray.ray_pyembree import RayMeshIntersector

from disco_twin.deviation import actual_rig
from hw.errors import DiscoError
from pipeline.calibrate.projector import TwoMirrorProjector
from pipeline.calibrate.projector_fit import ProjectorFit, StepSize, dlt, projection, refine, step_size

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Lit:
    """Spots in the world frame of a seeded rig whose turntable is exact."""

    nominal: TwoMirrorProjector
    actual: TwoMirrorProjector
    points: F64
    seen: F64  # with noise, the peak's shift and false spots
    steps: F64
    normals: F64
    to_eye: F64
    directions: F64
    false: NDArray[np.bool_]
    size: StepSize


def lit(seed: int, noise: float = 0.05, false: float = 0.2) -> Lit:
    rig, rng, mesh = faulty_rig(), np.random.default_rng(seed), world().object.mesh
    actual = actual_rig(rig, seed)
    turns = [actual.turns[aim.angle] for aim in world().plan.spots]
    origin, way = actual.spot_rays(world().plan.spots)
    points, ray, face = RayMeshIntersector(mesh).intersects_location(origin, way, multiple_hits=False)
    normals, way = mesh.face_normals[face], way[ray]
    moved = [turns[r] for r in ray]
    world_points = np.array([t[:3, :3] @ p + t[:3, 3] for t, p in zip(moved, points, strict=True)])
    normals, way = (np.array([t[:3, :3] @ x for t, x in zip(moved, v, strict=True)]) for v in (normals, way))
    eye = actual.cameras[0].position - world_points
    eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    error = noise * rng.standard_normal(points.shape)
    error -= (error * normals).sum(axis=1, keepdims=True) * normals
    seen = world_points + error
    for direction in (way, eye):
        seen = seen + shifted(direction - (direction * normals).sum(axis=1, keepdims=True) * normals)
    bad = rng.random(len(points)) < false
    seen[bad] += 8 * rng.standard_normal((bad.sum(), 3))
    steps = np.array([(world().plan.spots[r].u, world().plan.spots[r].v) for r in ray], float)
    full = actual.projector.full_angle_rad
    size = StepSize(full * (1 + 0.002 * rng.standard_normal(2)), 0.002 * full)
    nominal = TwoMirrorProjector.from_config(rig.projector)
    return Lit(nominal, actual.projector, world_points, seen, steps, normals, eye, way, bad, size)


def fitted(spots: Lit, **changes: object) -> ProjectorFit:
    spots = replace(spots, **changes)  # type: ignore[arg-type]
    kept = projection(spots.seen, spots.steps, 40.0, np.random.default_rng(0)).inliers
    arguments = (spots.seen[kept], spots.steps[kept], spots.normals[kept], spots.to_eye[kept], spots.size)
    return refine(spots.nominal, *arguments)


def accuracy(fit: ProjectorFit, spots: Lit) -> tuple[float, float]:
    """Root mean square distance of predicted spots on the surface in mm; largest error of incidence in degrees."""
    origin, way = fit.projector.rays(spots.steps)
    along = ((spots.points - origin) * spots.normals).sum(axis=1) / (way * spots.normals).sum(axis=1)
    miss = np.linalg.norm(origin + along[:, None] * way - spots.points, axis=1)
    turned = np.arccos(np.clip((way * spots.directions).sum(axis=1), -1, 1))
    return float(np.sqrt((miss**2).mean())), float(np.rad2deg(turned).max())


def test_the_projector_is_found_among_false_spots() -> None:
    """A fifth of the spots is false. Expected: spots within .15 mm, directions within .3 degrees."""
    for seed in range(3):
        spots = lit(seed)
        fit = fitted(spots)
        miss, turned = accuracy(fit, spots)
        assert miss < 0.15
        assert turned < 0.3


def test_an_exact_projection_is_found_exactly() -> None:
    """A pinhole's matrix comes back, with its centre as the null vector; t3 = 0 is no exception."""
    rng = np.random.default_rng(1)
    truth = rng.standard_normal((3, 4)) * [1, 1, 1, 100]
    truth[2, 3] = 0.0
    points = rng.standard_normal((40, 3)) * 20 + [0, 0, 70]
    u, v, w = (np.column_stack([points, np.ones(40)]) @ truth.T).T
    steps = np.column_stack([u / w, v / w])
    found = dlt(points, steps)
    same = np.sign(found[0, 0] * truth[0, 0]) / np.linalg.norm(truth)
    np.testing.assert_allclose(found / np.linalg.norm(found), truth * same, atol=1e-9)
    result = projection(points, steps, 1e-3, rng)
    centre = np.linalg.solve(truth[:, :3], -truth[:, 3])
    np.testing.assert_allclose(result.centre, centre, rtol=1e-6, atol=1e-6)


def test_nearly_coplanar_spots_are_refused_with_the_reason() -> None:
    rng = np.random.default_rng(2)
    flat = np.column_stack([rng.uniform(-20, 20, (60, 2)), rng.normal(0, 0.05, 60)])
    with pytest.raises(DiscoError, match=r"nearly coplanar.*Remedy"):
        projection(flat, rng.uniform(0, 4095, (60, 2)), 40.0, rng)


def test_nonsense_is_refused() -> None:
    rng = np.random.default_rng(3)
    with pytest.raises(DiscoError, match="agree on a projector"):
        projection(rng.standard_normal((60, 3)) * 20, rng.uniform(0, 4095, (60, 2)), 5.0, rng)


def test_the_peak_shift_does_not_pass_for_the_projector() -> None:
    """Spots moved along the light's way and towards the eye: the fit says by how much, within 4 sigma."""
    fit = fitted(lit(4))
    assert (np.abs(fit.shift - SHIFT) < 4 * fit.shift_error).all()
    assert fit.shift_error[0] < 0.1


@pytest.mark.parametrize("broken", ["swapped axes", "wrong sign", "degrees for radians", "transposed pose"])
def test_a_broken_stage_shows(broken: str) -> None:
    """Each mistake leaves the bounds of the good fit, or is refused."""
    spots = lit(5)
    if broken == "swapped axes":
        spots = replace(spots, steps=spots.steps[:, ::-1])
    if broken == "wrong sign":
        spots = replace(spots, steps=spots.steps * [-1, 1] + [4095, 0])
    if broken == "degrees for radians":
        size = StepSize(np.rad2deg(spots.size.full_angle_rad), spots.size.error_rad)
        spots = replace(spots, size=size)
    if broken == "transposed pose":
        pose = spots.nominal.pose.copy()
        pose[:3, :3] = pose[:3, :3].T
        spots = replace(spots, nominal=replace(spots.nominal, pose=pose))
    try:
        fit = fitted(spots)
    except (DiscoError, np.linalg.LinAlgError):
        return
    miss, turned = accuracy(fit, spots)
    assert miss > 0.15 or turned > 0.3 or fit.rms_mm > 0.15 or fit.false.mean() > 0.3


def test_the_plane_measurement_gives_the_step_size() -> None:
    """With the first mirror's separation: without it (thesis figure 5.2) the first angle is 2 % too large."""
    nominal = lit(0).nominal
    truth = replace(nominal, full_angle_rad=nominal.full_angle_rad * [1.003, 0.996], pose=np.eye(4))
    grid = np.stack(np.meshgrid(np.linspace(500, 3600, 5), np.linspace(500, 3600, 5)), axis=-1).reshape(-1, 2)
    origin, way = truth.rays(grid)
    on_plane = origin + ((600 - origin[:, 2]) / way[:, 2])[:, None] * way
    found = step_size(on_plane[:, :2], grid, np.full(25, 600.0), 0.5, nominal, 0.02)
    np.testing.assert_allclose(found.full_angle_rad, truth.full_angle_rad, rtol=1e-4)
    assert (found.error_rad > 0).all()
    single = step_size(on_plane[:, :2], grid, np.full(25, 600.0), 0.5, replace(nominal, separation_mm=0.0), 0.02)
    assert single.full_angle_rad[0] / truth.full_angle_rad[0] - 1 == pytest.approx(12 / 600, rel=0.05)


def test_uncertainties_are_honest() -> None:
    """z-scores of the eight figures over many seeds: root mean square between .8 and 1.25."""
    scores = []
    for seed in range(24):
        spots = lit(100 + seed)
        fit = fitted(spots)
        pose = fit.projector.pose
        turned = Rotation.from_matrix(spots.actual.pose[:3, :3] @ pose[:3, :3].T).as_rotvec()
        shifted = spots.actual.pose[:3, 3] - pose[:3, 3]
        wide = spots.actual.full_angle_rad - fit.projector.full_angle_rad
        scores.append(np.concatenate([turned, shifted, wide]) / np.sqrt(np.diag(fit.covariance)))
    assert 0.8 < np.sqrt((np.array(scores) ** 2).mean()) < 1.25
