"""The projector from spots: DLT, false spots, coplanar spots, the two-mirror fit, and that a broken stage shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrate_twin import SHIFT, faulty_rig
from projector_fakes import F64, accuracy, fitted, lit
from scipy.spatial.transform import Rotation

from disco_twin.faults.actual_rig import actual_rig
from hw.base.errors import DiscoError
from pipeline.calibrate.projector_fit import ProjectorFit, StepSize, dlt, refine, step_size, true_spots
from pipeline.calibrate.projector_prior import against_cameras
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.projector import TwoMirrorProjector
from pipeline.plan.targets import make_targets


def test_the_projector_is_found_among_false_spots() -> None:
    """A fifth of the spots is false. Expected: spots within .15 mm, directions within .3 degrees."""
    for seed in range(3):
        spots = lit(seed)
        fit = fitted(spots)
        miss, turned = accuracy(fit, spots)
        assert miss < 0.15
        assert turned < 0.3


def test_an_exact_projection_is_found_exactly() -> None:
    """A pinhole's matrix comes back, and with it every spot as a true one; t3 = 0 is no exception."""
    rng = np.random.default_rng(1)
    truth = rng.standard_normal((3, 4)) * [1, 1, 1, 100]
    truth[2, 3] = 0.0
    points = rng.standard_normal((40, 3)) * 20 + [0, 0, 70]
    u, v, w = (np.column_stack([points, np.ones(40)]) @ truth.T).T
    steps = np.column_stack([u / w, v / w])
    found = dlt(points, steps)
    same = np.sign(found[0, 0] * truth[0, 0]) / np.linalg.norm(truth)
    np.testing.assert_allclose(found / np.linalg.norm(found), truth * same, atol=1e-9)
    assert true_spots(points, steps, 1e-3, rng).all()


def test_nearly_coplanar_spots_are_refused_with_the_reason() -> None:
    rng = np.random.default_rng(2)
    flat = np.column_stack([rng.uniform(-20, 20, (60, 2)), rng.normal(0, 0.05, 60)])
    with pytest.raises(DiscoError, match=r"nearly coplanar.*Remedy"):
        true_spots(flat, rng.uniform(0, 4095, (60, 2)), 40.0, rng)


def test_nonsense_is_refused() -> None:
    rng = np.random.default_rng(3)
    with pytest.raises(DiscoError, match="agree on a projector"):
        true_spots(rng.standard_normal((60, 3)) * 20, rng.uniform(0, 4095, (60, 2)), 5.0, rng)


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
        size = StepSize(np.rad2deg(spots.size.full_angle_rad), spots.size.covariance)
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
    depth = np.diag([0, 0, 0, 0, 0, 0.5**2])
    found = step_size(on_plane, grid, depth, nominal, 0.02)
    np.testing.assert_allclose(found.full_angle_rad, truth.full_angle_rad, rtol=1e-4)
    assert (np.diag(found.covariance) > 0).all()
    single = step_size(on_plane, grid, depth, replace(nominal, separation_mm=0.0), 0.02)
    assert single.full_angle_rad[0] / truth.full_angle_rad[0] - 1 == pytest.approx(12 / 600, rel=0.05)


def test_the_plane_measurement_counts_how_its_plane_may_be_moved() -> None:
    """Perfect spots on a camera's plates, moved by half a degree and .4 mm (standard deviations): chi^2 of 2.

    The mean of 300 is 2 +- .115, and without the rotation beyond all bounds. Depth alone moves both angles as one.
    """
    rig, rng, turned = faulty_rig(), np.random.default_rng(6), np.deg2rad(0.5)
    nominal, (targets, plan) = TwoMirrorProjector.from_config(rig.projector), make_targets(rig, 0)
    steps = np.array([(a.u, a.v) for a in plan.spots], float)
    plates = np.array([targets.placements[a.angle].pose for a in plan.spots])
    origin, way = nominal.rays(steps)
    along = ((plates[:, :3, 3] - origin) * plates[:, :3, 2]).sum(axis=1) / (way * plates[:, :3, 2]).sum(axis=1)
    world_points = origin + along[:, None] * way
    motion, pivot = np.diag([turned**2] * 3 + [0.4**2] * 3), nominal.pose[:3, 3]
    local = world_points @ nominal.pose[:3, :3].T + pivot
    scores = []
    for _ in range(300):
        off = np.sqrt(np.diag(motion)) * rng.standard_normal(6)
        there = Rotation.from_rotvec(off[:3]).apply(local - pivot) + pivot + off[3:]
        found = step_size(there, steps, motion, nominal, 1e-4)
        miss = found.full_angle_rad - nominal.full_angle_rad
        scores.append(miss @ np.linalg.inv(found.covariance) @ miss)
    assert abs(np.mean(scores) - 2) < 4 * 0.115
    one = step_size(local, steps, np.diag([0, 0, 0, 0, 0, 0.4**2]), nominal, 1e-4).covariance
    assert one[0, 1] / np.sqrt(one[0, 0] * one[1, 1]) > 0.99


def test_the_projector_does_not_depend_on_the_frame_of_the_scan() -> None:
    """Spots, normals and found cameras moved by 3 degrees and 10 mm: the projector moves with them.

    Held to the place where it was built to stand in the rig's own frame, it does not.
    """
    rig, actual = faulty_rig(), actual_rig(faulty_rig(), 7)
    spots, motion = lit(7, false=0.0), np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(np.deg2rad(3.0) * np.array([2, -1, 2]) / 3).as_matrix()
    motion[:3, 3] = 10.0 * np.array([-1, 2, 2]) / 3
    cameras, exact = [PinholeCamera.from_config(c) for c in rig.cameras], [1e-12 * np.eye(6)] * len(rig.cameras)
    fits = []
    for move in (np.eye(4), motion):
        found = [c.seen_from(np.linalg.inv(move)) for c in actual.cameras]
        start, place = against_cameras(spots.nominal, cameras, found, exact)
        seen = spots.seen @ move[:3, :3].T + move[:3, 3]
        normals, eyes = (x @ move[:3, :3].T for x in (spots.normals, spots.to_eye))
        fit = refine(start, seen, spots.steps, normals, eyes, spots.size, place=place)
        assert np.abs(score(fit, spots.actual.seen_from(np.linalg.inv(move)))).max() < 4
        fits.append(fit)
    assert np.abs(score(fits[1], fits[0].projector.seen_from(np.linalg.inv(motion)))).max() < 0.1
    lost = refine(spots.nominal, seen, spots.steps, normals, eyes, spots.size)
    assert np.abs(score(lost, fits[1].projector)).max() > 0.5


def score(fit: ProjectorFit, truth: TwoMirrorProjector) -> F64:
    """(8,) z-scores of pose and full angles."""
    pose = fit.projector.pose
    turned = Rotation.from_matrix(truth.pose[:3, :3] @ pose[:3, :3].T).as_rotvec()
    moved, wide = truth.pose[:3, 3] - pose[:3, 3], truth.full_angle_rad - fit.projector.full_angle_rad
    return np.asarray(np.concatenate([turned, moved, wide]) / np.sqrt(np.diag(fit.covariance)))


def test_uncertainties_are_honest() -> None:
    """z-scores of the eight figures over many seeds: root mean square between .8 and 1.25."""
    scores = []
    for seed in range(24):
        spots = lit(100 + seed)
        fit = fitted(spots)
        scores.append(score(fit, spots.actual))
    assert 0.8 < np.sqrt((np.array(scores) ** 2).mean()) < 1.25
