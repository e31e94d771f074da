"""Procedural shapes: closed, outward, fine; volumes and areas against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from disco_twin.object import shapes
from disco_twin.object.mesh import depth
from disco_twin.scene.shape_schema import Box, Pebble, Sphere, Torus


def all_shapes() -> dict[str, trimesh.Trimesh]:
    return {
        "pebble": shapes.pebble(Pebble(kind="pebble")),
        "pebble-7": shapes.pebble(Pebble(kind="pebble", seed=7)),
        "sphere": shapes.sphere(Sphere(kind="sphere")),
        "box": shapes.box(Box(kind="box", size_mm=(30, 20, 10))),
        "slab": shapes.box(Box(kind="box", size_mm=(40, 40, 0.2))),
        "torus": shapes.torus(Torus(kind="torus")),
    }


@pytest.mark.parametrize("name", all_shapes())
def test_closed_outward_and_fine(name: str) -> None:
    mesh = all_shapes()[name]
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert 15_000 < len(mesh.faces) < 25_000
    assert mesh.body_count == 1
    assert mesh.euler_number == (0 if name == "torus" else 2)


def test_volumes_and_areas() -> None:
    """Inscribed meshes miss volume of the order of edge^2 / (4 r^2): well below 0.5 % here; boxes are exact."""
    made = all_shapes()
    assert made["sphere"].volume == pytest.approx(4 / 3 * np.pi * 20**3, rel=2e-3)
    assert made["torus"].volume == pytest.approx(2 * np.pi**2 * 14 * 6**2, rel=5e-3)
    assert made["box"].volume == pytest.approx(6000, rel=1e-12)
    assert made["box"].area == pytest.approx(2200, rel=1e-12)
    assert made["slab"].volume == pytest.approx(320, rel=1e-12)
    assert made["slab"].extents == pytest.approx([40, 40, 0.2])


@pytest.mark.parametrize("seed", range(5))
def test_pebble_is_smooth_concave_and_of_its_size(seed: int) -> None:
    mesh = shapes.pebble(Pebble(kind="pebble", size_mm=(40, 36, 32), seed=seed))
    np.testing.assert_allclose(mesh.bounds, [[-20, -18, -16], [20, 18, 16]], atol=1e-9)
    assert np.degrees(mesh.face_adjacency_angles.max()) < 12  # no crease between neighbouring triangles
    sunk = depth(mesh.convex_hull, np.array(mesh.vertices))
    assert sunk.max() > 1.5  # a dent that light can cross in the open
    assert (sunk > 0.2).mean() > 0.05
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert radius.max() / radius.min() > 1.25
    assert mesh.edges_unique_length.max() < 1.2


def test_pebbles_repeat_and_differ_by_seed() -> None:
    one, again, other = (shapes.pebble(Pebble(kind="pebble", seed=s)).vertices for s in (1, 1, 2))
    assert np.array_equal(one, again)
    assert np.abs(one - other).max() > 1


def test_torus_that_cuts_itself_is_refused() -> None:
    with pytest.raises(ValueError, match="cut itself"):
        Torus(kind="torus", ring_radius_mm=5, tube_radius_mm=6)
