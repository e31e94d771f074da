"""Prisms: exact volumes and areas, sharp edges, holes; what polygons are refused."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from matplotlib.path import Path as Outline
from scipy.spatial.transform import Rotation

from disco_twin.object.extrusion import extrusion
from disco_twin.scene.polygons import distance_to_sides, inside
from disco_twin.scene.shape_schema import Extrusion
from hw.base.errors import InputError

Ring = tuple[tuple[float, float], ...]
L_SHAPE: Ring = ((-15, -10), (15, -10), (15, 0), (0, 0), (0, 12), (-15, 12))  # 480 mm^2, around 104 mm
SQUARE: Ring = ((-12, -7), (-6, -7), (-6, -1), (-12, -1))
TRIANGLE: Ring = ((5, -8), (11, -8), (8, -4))


def made(outline: Ring = L_SHAPE, *holes: Ring, height: float = 8.0, turn: tuple[float, ...] = (0, 0, 0)) -> Extrusion:
    shape = {"kind": "extrusion", "outline_mm": outline, "holes_mm": holes, "height_mm": height, "turn_deg": turn}
    return Extrusion.model_validate(shape)


@pytest.mark.parametrize("holes", [(), (SQUARE,), (SQUARE, TRIANGLE), (SQUARE[::-1], TRIANGLE[::-1])])
@pytest.mark.parametrize("outline", [L_SHAPE, L_SHAPE[::-1]])
def test_volume_area_and_topology(outline: Ring, holes: tuple[Ring, ...]) -> None:
    """Whichever way round the rings run."""
    mesh = extrusion(made(outline, *holes))
    base = 480 - sum((36, 12)[: len(holes)])
    around = 104 + sum((24, 6 + 2 * 5)[: len(holes)])
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(base * 8, rel=1e-12)
    assert mesh.area == pytest.approx(2 * base + around * 8, rel=1e-12)
    assert mesh.euler_number == 2 - 2 * len(holes)
    assert len(mesh.faces) == pytest.approx(20_000, rel=0.15)


def test_triangles_are_nearly_equal_and_edges_sharp() -> None:
    mesh = extrusion(made(L_SHAPE, SQUARE, TRIANGLE))
    assert mesh.area_faces.std() < 0.2 * mesh.area_faces.mean()
    assert np.degrees(mesh.face_angles.min()) > 20
    bent = np.degrees(mesh.face_adjacency_angles)
    assert not ((bent > 1e-3) & (bent < 50)).any()  # flat within a face; the sharpest corner is the triangle's
    corners = np.array([(x, y, z) for ring in (L_SHAPE, SQUARE, TRIANGLE) for x, y in ring for z in (-4, 4)])
    apart = np.linalg.norm(mesh.vertices[:, None] - corners, axis=2).min(axis=0)
    np.testing.assert_allclose(apart, 0, atol=1e-12)


def test_it_is_turned_about_the_origin() -> None:
    turn = (25.0, -50.0, 130.0)
    straight, turned = extrusion(made(L_SHAPE, SQUARE)), extrusion(made(L_SHAPE, SQUARE, turn=turn))
    expected = Rotation.from_euler("xyz", turn, degrees=True).apply(straight.vertices)
    np.testing.assert_allclose(turned.vertices, expected, atol=1e-12)


def test_a_coarse_one_keeps_its_edges() -> None:
    """The scan of an ideal scanner."""
    mesh = extrusion(made(L_SHAPE, SQUARE), triangles=1000)
    assert len(mesh.faces) == pytest.approx(1000, rel=0.3)
    assert mesh.volume == pytest.approx(444 * 8, rel=1e-12)


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "bow tie": (lambda: made(((-10, -10), (10, 10), (10, -10), (-10, 10))), r"outline_mm crosses or touches itself.*0"),
    "spike": (lambda: made(((-10, 0), (10, 0), (4, 0), (0, 9))), "outline_mm crosses or touches itself"),
    "corner twice": (lambda: made(((0, 0), (9, 0), (9, 0), (0, 9))), "outline_mm crosses or touches itself"),
    "through the outline": (lambda: made(L_SHAPE, ((-20, -7), (-6, -7), (-6, -1))), r"outline_mm meets holes_mm\[0\]"),
    "at the outline": (lambda: made(L_SHAPE, ((-15, -7), (-6, -7), (-6, -1))), r"outline_mm meets holes_mm\[0\]"),
    "outside": (lambda: made(L_SHAPE, ((3, 3), (6, 3), (6, 6))), r"holes_mm\[0\] lies outside outline_mm"),
    "nested": (
        lambda: made(L_SHAPE, SQUARE, ((-11, -6), (-7, -6), (-7, -2))),
        r"holes_mm\[1\] lies inside holes_mm\[0\]",
    ),
    "two corners": (lambda: made(((0, 0), (9, 0))), "at least 3"),
    "no height": (lambda: made(height=0.0), "greater than 0"),
    "thin wall": (
        lambda: extrusion(made(L_SHAPE, ((-14.97, -8), (-6, -8), (-6, 3), (-14.97, 3)))),
        "too fine for triangles",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(name: str) -> None:
    make, message = REFUSED[name]
    with pytest.raises((ValueError, InputError), match=message):
        make()


def test_inside_agrees_with_another_implementation() -> None:
    random = np.random.default_rng(3)
    for corners in (3, 5, 12):
        angle = np.sort(random.uniform(0, 2 * np.pi, corners))
        ring = np.column_stack([np.cos(angle), np.sin(angle)]) * random.uniform(2, 9, corners)[:, None]
        points = random.uniform(-10, 10, (2000, 2))
        clear = distance_to_sides(points, [ring]) > 1e-9
        assert np.array_equal(inside(points, [ring])[clear], Outline(ring).contains_points(points)[clear])
