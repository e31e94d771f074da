"""Mesh files: what is read and what is refused; distances; hat functions between meshes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from disco_twin.object import shapes
from disco_twin.object.mesh import depth, hat_basis, read_mesh
from disco_twin.scene.shape_schema import Pebble, Sphere
from hw.base.errors import InputError
from pipeline.geometry.mesh import closest
from pipeline.geometry.remesh import remesh

PEBBLE = shapes.pebble(Pebble(kind="pebble"))


def ball(radius: float = 20.0) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=2, radius=radius)


def opened() -> trimesh.Trimesh:
    mesh = ball()
    mesh.update_faces(np.arange(len(mesh.faces)) > 2)
    return mesh


def inside_out() -> trimesh.Trimesh:
    return trimesh.Trimesh(ball().vertices, ball().faces[:, ::-1], process=False)


def half_flipped() -> trimesh.Trimesh:
    faces = ball().faces.copy()
    faces[::2] = faces[::2, ::-1]
    return trimesh.Trimesh(ball().vertices, faces, process=False)


REFUSED: list[tuple[Callable[[], trimesh.Trimesh], str]] = [
    (opened, r"not closed \(9 of 480 edges.*Remedy: `disco-twin mesh .*mesh\.\w+ .*mesh-closed.ply` closes it"),
    (inside_out, "inside out.*`disco-twin mesh"),
    (half_flipped, "not all oriented the same way.*`disco-twin mesh"),
    (lambda: ball(0.02), "0.04 mm large.*1 .. 2000 mm.*metres"),
    (lambda: ball(20_000), "large.*1 .. 2000 mm.*micrometres"),
]


@pytest.mark.parametrize(("make", "message"), REFUSED, ids=["open", "inverted", "mixed", "metres", "micrometres"])
@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl"])
def test_refused(make: Callable[[], trimesh.Trimesh], message: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"mesh{suffix}"
    make().export(path)
    with pytest.raises(InputError, match=message) as caught:
        read_mesh(path)
    assert str(path) in str(caught.value)
    assert "object.shape.file" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl"])
def test_good_meshes_keep_their_shape(suffix: str, tmp_path: Path) -> None:
    """Cutting triangles in four leaves every point of the surface where it was."""
    original = ball()
    original.export(tmp_path / f"ball{suffix}")
    mesh = read_mesh(tmp_path / f"ball{suffix}")
    assert mesh.is_watertight
    assert len(mesh.faces) >= 20_000
    assert mesh.volume == pytest.approx(original.volume, rel=1e-6)
    assert mesh.area == pytest.approx(original.area, rel=1e-6)


def test_closest_and_depth_on_a_sphere() -> None:
    sphere = shapes.sphere(Sphere(kind="sphere", radius_mm=20))
    points = np.random.default_rng(0).normal(size=(500, 3)) * 15
    radius = np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(depth(sphere, points), 20 - radius[:, 0], atol=0.02)
    found, triangles = closest(sphere, points)
    assert triangles.max() < len(sphere.faces)
    np.testing.assert_allclose(found, points / radius * 20, atol=0.6)  # within an edge
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 20, atol=0.02)


def test_hat_basis_is_a_partition_of_unity_that_reproduces_linear_functions() -> None:
    scan = remesh(PEBBLE, 642)
    basis = hat_basis(PEBBLE, scan)
    assert basis.shape == (len(PEBBLE.vertices), len(scan.vertices))
    assert basis.data.min() >= 0
    assert np.diff(basis.indptr).max() <= 3
    np.testing.assert_allclose(basis.sum(axis=1), 1, atol=1e-12)
    # sum_v hat_v(x) x_v is the point of the scan's surface itself
    points, _ = closest(scan, np.array(PEBBLE.vertices))
    np.testing.assert_allclose(basis @ scan.vertices, points, atol=1e-9)
    identity = hat_basis(PEBBLE, PEBBLE)
    assert (identity != identity.T).nnz == 0
    assert identity.nnz == len(PEBBLE.vertices)


def test_scan_finer_than_the_mesh_is_refused() -> None:
    with pytest.raises(InputError, match=r"scan\.vertices.*finer mesh"):
        hat_basis(ball(), PEBBLE)
