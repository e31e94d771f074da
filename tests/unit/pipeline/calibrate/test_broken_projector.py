"""Slips on purpose in the projector's calibration, and in what tells hidden spots from seen ones.

The stage's own score, or its z-score, sees each of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from calibrate_slips import F64, Patch, Slip, require_seen
from calibrate_twin import (
    Glowing,
    faulty_rig,
    world,
)
from numpy.typing import NDArray
from projector_fakes import accuracy, fitted, lit
from trimesh.ray.ray_pyembree import RayMeshIntersector

from disco_twin.faults.actual_rig import actual_rig
from hw.base.errors import DiscoError
from pipeline.calibrate import calibrate_rig as measure
from pipeline.calibrate import peaks, projector_fit
from pipeline.geometry.projector import TwoMirrorProjector


def step_score(change: Callable[[F64], F64] = lambda steps: steps, separation: float = 1.0) -> float:
    """Largest z-score of the two full angles, from spots on a plane."""
    nominal, grid, place = ON_A_PLANE
    given = replace(nominal, separation_mm=separation * nominal.separation_mm)
    found = projector_fit.step_size(place, change(grid), DEPTH_ALONE, given, 0.02)
    return float(np.abs((found.full_angle_rad - nominal.full_angle_rad * TRUE_ANGLES) / found.error_rad).max())


TRUE_ANGLES = np.array([1.003, 0.996])
DEPTH_ALONE = np.diag([0, 0, 0, 0, 0, 0.5**2])


def _on_a_plane() -> tuple[TwoMirrorProjector, F64, F64]:
    nominal = TwoMirrorProjector.from_config(faulty_rig().projector)
    truth = replace(nominal, full_angle_rad=nominal.full_angle_rad * TRUE_ANGLES, pose=np.eye(4))
    grid = np.stack(np.meshgrid(np.linspace(500, 3600, 5), np.linspace(500, 3600, 5)), axis=-1).reshape(-1, 2)
    origin, way = truth.rays(grid)
    place = origin + ((600 - origin[:, 2]) / way[:, 2])[:, None] * way
    place[:, :2] += 0.02 * np.random.default_rng(3).standard_normal((25, 2))
    return nominal, grid, place


ON_A_PLANE = _on_a_plane()
STEP: dict[str, Callable[[], float]] = {
    "axes swapped": lambda: step_score(lambda steps: steps[:, ::-1]),
    "wrong sign": lambda: step_score(lambda steps: 4095 - steps),
    "degrees for radians": lambda: step_score(lambda steps: np.rad2deg(steps - 2047.5) + 2047.5),
    "one pivot for both mirrors": lambda: step_score(separation=0.0),
}


@pytest.mark.parametrize("name", STEP)
def test_step_size_slips_show(name: str) -> None:
    good = max(step_score(), 1.0)
    assert good < 3
    require_seen(STEP[name], good, 5)


def thesis_fourth_column(points: F64, steps: F64) -> F64:
    """As printed: 1, 2, 3 where all must be 1, and t3 fixed at 1."""
    homogeneous = np.column_stack([points, np.resize([1.0, 2.0, 3.0], len(points))])
    none = np.zeros_like(homogeneous)
    rows = np.concatenate(
        [
            np.hstack([homogeneous, none, -steps[:, :1] * points]),
            np.hstack([none, homogeneous, -steps[:, 1:] * points]),
        ]
    )
    solved = np.linalg.lstsq(rows, steps.T.ravel(), rcond=None)[0]
    return np.append(solved, 1.0).reshape(3, 4)


def matrix_score() -> float:
    """mm from the matrix's centre to where the projector stands."""
    spots = lit(7, noise=0.02, false=0.1)
    found = projector_fit.projection(spots.points, spots.steps, 40.0, np.random.default_rng(0))
    true = spots.actual
    return float(np.linalg.norm(found.centre + true.pose[:3, :3].T @ true.pose[:3, 3]))


def not_transposed_back(points: F64, steps: F64) -> F64:
    here, there = projector_fit._normaliser(points), projector_fit._normaliser(steps)
    real = DLT(points, steps)
    return np.asarray(np.linalg.inv(there) @ (there @ real @ np.linalg.inv(here)) @ here.T)


DLT = projector_fit.dlt
MATRIX: dict[str, Callable[[F64, F64], F64]] = {
    "fourth column of the thesis": thesis_fourth_column,
    "axes swapped": lambda points, steps: DLT(points[:, [1, 0, 2]], steps),
    "normaliser transposed": not_transposed_back,
    "centre from t": lambda points, steps: np.column_stack([DLT(points, steps)[:, :3], -DLT(points, steps)[:, 3]]),
}


@pytest.mark.parametrize("name", MATRIX)
def test_projection_matrix_slips_show(name: str, monkeypatch: Patch) -> None:
    good = matrix_score()
    assert good < 60  # of 600: two mirrors are no pinhole
    monkeypatch.setattr(projector_fit, "dlt", MATRIX[name])
    require_seen(matrix_score, good, 3)


def two_mirror_score() -> float:
    """mm, rms of predicted spots on the surface."""
    spots = lit(5)
    return accuracy(fitted(spots), spots)[0]


def test_two_mirror_slips_show(monkeypatch: Patch) -> None:
    """Axes swapped, sign, degrees and a transposed pose: those in the fit itself, judged by the true projector."""
    spots, good = lit(5), two_mirror_score()
    assert good < 0.15
    slips: dict[str, Callable[[TwoMirrorProjector, F64], F64]] = {
        "axes swapped": lambda p, s: REAL_ANGLES(p, s)[:, ::-1],
        "wrong sign": lambda p, s: REAL_ANGLES(p, s) * [1, -1],
        "degrees": lambda p, s: np.rad2deg(REAL_ANGLES(p, s)),
        "five steps": lambda p, s: REAL_ANGLES(p, s + np.linspace(-5, 5, len(s))[:, None]),
    }
    for name, slip in slips.items():
        monkeypatch.setattr(TwoMirrorProjector, "angles", slip)
        try:
            fit = fitted(spots)
            bad = fit.rms_mm * (1 + 10 * fit.false.mean())
        except DiscoError:
            bad = np.inf
        monkeypatch.setattr(TwoMirrorProjector, "angles", REAL_ANGLES)
        if np.isfinite(bad):
            bad = max(bad, accuracy(fit, spots)[0])
        assert bad > 2 * good, name


REAL_ANGLES = TwoMirrorProjector.angles


@dataclass(frozen=True)
class Hidden:
    """Peaks of spots as both cameras see them; visible: whether each sees the spot itself, by ray casting."""

    peaks: list[peaks.Peak]
    power: F64
    beam_px: float
    visible: NDArray[np.bool_]

    def score(self) -> float:
        """Share of the images that are taken for what they are not."""
        bright = measure.brightness(self.peaks, self.power)
        return float((measure.seen(self.peaks, self.power, self.beam_px, bright) != self.visible).mean())


@pytest.fixture(scope="module")
def hidden() -> Hidden:
    rig = faulty_rig(angles=(0.0,))
    actual, mesh = actual_rig(rig, 6), world().object.mesh
    source, caster = Glowing(rig, actual, mesh), RayMeshIntersector(mesh)
    found, visible, power = [], [], []
    rng = np.random.default_rng(4)
    aims = [a for a in world().plan.spots if a.angle == 0][::2]
    for camera in range(2):
        eye = actual.camera(camera, 0).position
        for aim in aims:
            origin, way = actual.spot_rays([aim])
            spot, _, face = caster.intersects_location(origin, way, multiple_hits=False)
            if not len(face):
                continue
            towards = eye - spot[0]
            towards /= np.linalg.norm(towards)
            normal = mesh.face_normals[face[0]]
            blocked = caster.intersects_any((spot[0] + 1e-3 * normal)[None], towards[None])[0]
            if abs(normal @ towards) < 0.15:
                continue  # at the rim either answer is right
            watts = float(rng.uniform(0.004, 0.012))
            image = source.image(camera, aim, 0) * watts
            found.append(peaks.find_peak(image + 2e-7 * rng.standard_normal(image.shape)))
            visible.append(bool(normal @ towards > 0 and not blocked))
            power.append(watts)
    beam = rig.projector.beam_diameter_mm * actual.cameras[0].focal[0] / 450.0
    return Hidden(found, np.array(power), float(beam), np.array(visible))


def each_camera_by_itself(patch: Patch) -> None:
    patch.setattr(measure, "brightness", lambda p, power: 0.0)


HIDDEN: dict[str, Slip] = {
    "no measure of what is bright": each_camera_by_itself,
    "power in milliwatts": lambda patch: patch.setattr(
        measure, "seen", lambda p, power, beam, bright: peaks.seen(p, 1e3 * power, beam, bright)
    ),
    "sign": lambda patch: patch.setattr(measure, "seen", lambda *a: ~peaks.seen(*a)),
    "beam in metres": lambda patch: patch.setattr(
        measure, "seen", lambda p, power, beam, bright: peaks.seen(p, power, beam * 1e3, 0.0)
    ),
}


@pytest.mark.parametrize("name", HIDDEN)
def test_hidden_spot_slips_show(name: str, hidden: Hidden, monkeypatch: Patch) -> None:
    good = max(hidden.score(), 0.02)
    assert 0.2 < hidden.visible.mean() < 0.8
    assert good < 0.06
    HIDDEN[name](monkeypatch)
    require_seen(hidden.score, good, 5)
