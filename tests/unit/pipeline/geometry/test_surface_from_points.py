"""A scanner's points to a mesh: edges stay where the points have them, and a smooth body is remeshed as before."""

from __future__ import annotations

import gpytoolbox
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from hw.base.errors import InputError
from pipeline.geometry.mesh import RayMesh, arrays
from pipeline.geometry.surface_from_points import reconstruct_surface

NOISE_MM = 0.05
BOX = trimesh.creation.box((30.0, 24.0, 18.0))


def scanned(mesh: trimesh.Trimesh, count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points of a mesh, each off by a scanner's noise along its normal."""
    points, face = trimesh.sample.sample_surface(mesh, count, seed=seed)
    normals = np.asarray(mesh.face_normals)[face]
    noise = NOISE_MM * np.random.default_rng(seed).standard_normal((count, 1))
    return np.asarray(points) + noise * normals, normals


def rms_off(mesh: trimesh.Trimesh, points: NDArray[np.float64]) -> float:
    squared = gpytoolbox.squared_distance(points, *arrays(mesh), use_cpp=True)[0]
    return float(np.sqrt(np.mean(squared)))


def refused(*_: object) -> None:
    raise InputError("not today")


def test_a_scan_keeps_edges(monkeypatch: pytest.MonkeyPatch) -> None:
    """To less than the noise of single points, and at most half as far off as a mesh that rounds them."""
    points, normals = scanned(BOX, 8_000, 1)
    fresh = np.asarray(trimesh.sample.sample_surface(BOX, 8_000, seed=2)[0])
    mesh = reconstruct_surface(points, normals, 200)
    assert abs(mesh.volume / BOX.volume - 1) < 0.003
    assert mesh.is_watertight and abs(len(mesh.vertices) / 200 - 1) < 0.1
    areas = RayMesh.of(mesh).areas
    assert areas.std() < 0.4 * areas.mean()
    monkeypatch.setattr("pipeline.geometry.surface_from_points.remesh", refused)
    rounded = reconstruct_surface(points, normals, 200)
    assert rms_off(mesh, fresh) < min(NOISE_MM, 0.5 * rms_off(rounded, fresh))


def test_a_smooth_scan_has_no_edges_to_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    """What holds edges is left out, so that the meshes of smooth objects are the same bit for bit as without it."""

    def never(*_: object) -> None:
        raise AssertionError("a ball has no edges")

    monkeypatch.setattr("pipeline.geometry.surface_from_points.remesh", never)
    ball = trimesh.creation.icosphere(4, 12.0)
    mesh = reconstruct_surface(*scanned(ball, 4_000, 3), 200)
    assert abs(mesh.volume / ball.volume - 1) < 0.01
