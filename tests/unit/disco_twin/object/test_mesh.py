"""Mesh files: what is read and what is refused; the scan; hat functions between meshes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from disco_twin.object import shapes
from disco_twin.object.mesh import closest, depth, hat_basis, read_mesh, remesh
from disco_twin.scene.object_schema import Pebble, Sphere
from hw.base.errors import InputError

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
    (opened, r"not closed \(3 of \d+ edges|not closed \(\d+ of \d+ edges.*fill its holes"),
    (inside_out, "inside out.*normals outside"),
    (half_flipped, "not all oriented the same way"),
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


def test_refused_files(tmp_path: Path) -> None:
    empty = (
        "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    cases = {
        "points.ply": (empty, "empty"),
        "nothing.obj": ("# nothing\n", "empty|cannot be read"),
        "noise.stl": ("not a mesh at all", "empty|cannot be read"),
        "nothing.ply": ("", "empty|cannot be read"),
        "scene.glb": ("", "unknown type of mesh file"),
        "wrong.obj": ("v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 7\n", "does not exist|cannot be read"),
        "nan.obj": (
            "v 0 0 nan\nv 9 0 0\nv 0 9 0\nv 0 0 9\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n",
            "not a finite number",
        ),
        "flat.obj": ("v 0 0 0\nv 9 0 0\nv 5 0 0\nf 1 2 3\n", "degenerate"),
    }
    for name, (text, message) in cases.items():
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=message) as caught:
            read_mesh(tmp_path / name)
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


@pytest.mark.parametrize("vertices", [162, 642])
def test_scan_has_about_as_many_equal_triangles_near_the_surface(vertices: int) -> None:
    scan = remesh(PEBBLE, vertices)
    assert scan.is_watertight
    assert abs(len(scan.vertices) / vertices - 1) < 0.03
    assert scan.area_faces.std() / scan.area_faces.mean() < 0.3
    assert scan.area_faces.min() > 0.3 * scan.area_faces.mean()
    # Chords lie inside a convex surface; scaled to its area, the vertices stand a little outside.
    np.testing.assert_allclose(scan.area, PEBBLE.area, rtol=1e-9)
    edge = scan.edges_unique_length.mean()
    assert np.abs(depth(PEBBLE, np.array(scan.vertices))).max() < edge**2 / (4 * 16)  # half a chord's height
    assert np.array_equal(scan.vertices, remesh(PEBBLE, vertices).vertices)


def test_scan_error_falls_with_the_square_of_the_edge() -> None:
    """Chords of a smooth surface: four times the vertices, a quarter of the distance."""
    height = [np.abs(depth(PEBBLE, np.array(remesh(PEBBLE, n).vertices))).mean() for n in (200, 800)]
    assert 3 < height[0] / height[1] < 5.5


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
