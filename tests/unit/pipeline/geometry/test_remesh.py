"""The scan of an object: as many triangles as asked for, nearly equal, with its edges, its size and its place."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mesh_writers import L, obj, prism

from disco_twin.object import shapes
from disco_twin.object.mesh import depth, read_mesh
from disco_twin.scene.shape_schema import Box, Pebble, Sphere, Torus
from hw.base.errors import InputError
from pipeline.geometry.remesh import remesh

PEBBLE = shapes.pebble(Pebble(kind="pebble"))
CUBE = prism(np.array([[0, 0], [30, 0], [30, 30], [0, 30]], float), 30.0)


@cache
def pebble(vertices: int) -> trimesh.Trimesh:
    """Its scan, made once."""
    return remesh(PEBBLE, vertices)


def read(folder: Path, content: bytes) -> trimesh.Trimesh:
    (folder / "mesh.obj").write_bytes(content)
    return read_mesh(folder / "mesh.obj")


def require_nearly_equal_triangles(scan: trimesh.Trimesh, vertices: int) -> None:
    """Thesis, section 5.3.1."""
    assert scan.is_watertight
    assert abs(len(scan.vertices) / vertices - 1) < 0.04
    assert scan.area_faces.std() / scan.area_faces.mean() < 0.3
    assert scan.area_faces.min() > 0.3 * scan.area_faces.mean()


@pytest.mark.parametrize("vertices", [150, 300, 1600])
def test_a_cube_from_a_file_keeps_its_edges_and_its_size(vertices: int, tmp_path: Path) -> None:
    scan = remesh(read(tmp_path, obj(CUBE)), vertices)
    require_nearly_equal_triangles(scan, vertices)
    np.testing.assert_allclose(scan.bounds, [[0, 0, 0], [30, 30, 30]], atol=1e-6)
    assert scan.volume == pytest.approx(27000, rel=1e-6) and scan.area == pytest.approx(5400, rel=1e-6)
    flat = np.abs(np.asarray(scan.face_normals)).max(axis=1)
    np.testing.assert_allclose(flat, 1, atol=1e-9)  # no triangle cuts an edge off
    box = shapes.box(Box(kind="box", size_mm=(30.0, 30.0, 30.0)), triangles=2 * vertices)  # the scan of `kind = "box"`
    assert scan.volume == pytest.approx(box.volume, rel=1e-6) and scan.area == pytest.approx(box.area, rel=1e-6)
    np.testing.assert_allclose(scan.extents, box.extents, atol=1e-5)


@pytest.mark.parametrize(
    ("make", "faces"),
    [
        (lambda: obj(prism(L)), 8),
        (lambda: obj(prism(np.array([[0, 0], [40, 0], [40, 8], [0, 8]], float), 40.0)), 6),
    ],
    ids=["L", "plate"],
)
def test_concave_and_thin_blocks_stay_what_they_are(make: Callable[[], bytes], faces: int, tmp_path: Path) -> None:
    mesh = read(tmp_path, make())
    scan = remesh(mesh, 400)
    assert scan.volume == pytest.approx(mesh.volume, rel=1e-6) and scan.area == pytest.approx(mesh.area, rel=1e-6)
    planes = np.column_stack([scan.face_normals, (scan.face_normals * scan.triangles[:, 0]).sum(axis=1)])
    assert len(np.unique(np.round(planes, 4) + 0.0, axis=0)) == faces


@pytest.mark.parametrize(
    ("mesh", "vertices", "share"),
    [
        (PEBBLE, 162, 0.006),
        (PEBBLE, 642, 0.002),
        (shapes.sphere(Sphere(kind="sphere")), 642, 0.001),
        (shapes.torus(Torus(kind="torus")), 1200, 0.002),
    ],
    ids=["pebble-162", "pebble", "sphere", "torus"],
)
def test_curved_objects_keep_area_and_volume(mesh: trimesh.Trimesh, vertices: int, share: float) -> None:
    """Chords lie inside a convex surface; a polyhedron that has its volume has too much area. Half of both is left."""
    scan = pebble(vertices) if mesh is PEBBLE else remesh(mesh, vertices)
    require_nearly_equal_triangles(scan, vertices)
    assert scan.area == pytest.approx(mesh.area, rel=share)
    assert scan.volume == pytest.approx(mesh.volume, rel=share)


def test_the_same_object_gets_the_same_scan() -> None:
    assert np.array_equal(pebble(162).vertices, remesh(PEBBLE, 162).vertices)


def test_a_rim_keeps_its_height_and_its_radius() -> None:
    """A cylinder: the rim's vertices move outward with the side, and not up with the end."""
    mesh = trimesh.creation.cylinder(radius=15, height=30, sections=128).subdivide().subdivide().subdivide()
    scan = remesh(mesh, 300)
    np.testing.assert_allclose(scan.bounds[:, 2], [-15, 15], atol=0.01)
    assert scan.volume == pytest.approx(mesh.volume, rel=2e-3) and scan.area == pytest.approx(mesh.area, rel=2e-3)
    rim = np.abs(np.abs(scan.vertices[:, 2]) - 15) < 0.01
    radius = np.linalg.norm(scan.vertices[rim, :2], axis=1)
    assert (radius > 14.99).sum() > 2 * 12 and radius.max() < 15.2


def test_noise_makes_no_edges() -> None:
    """A scan's noise tilts single triangles by more than an edge of the object does."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=20)
    noise = np.random.default_rng(1).normal(size=len(ball.vertices)) * 0.25
    rough = trimesh.Trimesh(ball.vertices * (1 + noise / 20)[:, None], ball.faces, process=False)
    assert (rough.face_adjacency_angles > np.deg2rad(40)).mean() > 0.1
    scan = remesh(rough, 300)
    require_nearly_equal_triangles(scan, 300)
    assert scan.volume == pytest.approx(ball.volume, rel=0.01)


def test_distance_falls_with_the_square_of_the_edge() -> None:
    """Chords of a smooth surface: four times the vertices, a quarter of the distance."""
    height = [np.abs(depth(PEBBLE, np.array(pebble(n).vertices))).mean() for n in (162, 642)]
    assert 3 < height[0] / height[1] < 5.5


def test_too_few_vertices_for_a_closed_mesh() -> None:
    ring = trimesh.creation.torus(40, 1, major_sections=150, minor_sections=12)
    with pytest.raises(InputError, match=r"scan.vertices = 60: so few do not resolve the object. Remedy: raise"):
        remesh(ring, 60)
