"""Blends: volumes and areas against closed forms; closed, outward, of nearly equal triangles; what is refused."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from disco_twin.object.blend import TRIANGLES, blend, blend_function
from disco_twin.scene.shape_schema import Blend
from hw.base.errors import InputError


def made(*parts: dict[str, Any], rounding_mm: float = 0.5) -> Blend:
    return Blend.model_validate({"kind": "blend", "rounding_mm": rounding_mm, "parts": parts})


def ball(radius: float, x: float = 0.0, **more: Any) -> dict[str, Any]:
    return {"kind": "ellipsoid", "centre_mm": (x, 0.0, 0.0), "radii_mm": (radius,) * 3, **more}


EGG = {"kind": "ellipsoid", "centre_mm": (3.0, -2.0, 1.0), "radii_mm": (20.0, 15.0, 10.0), "turn_deg": (30, -40, 70)}
LIMB = {"kind": "capsule", "from_mm": (-6, 4, -10), "to_mm": (2, 0, 12), "radius_mm": 7.0, "to_radius_mm": 4.0}
ROD = {"kind": "capsule", "from_mm": (0, 0, -10), "to_mm": (0, 0, 10), "radius_mm": 8.0}


def tapered_volume(length: float, one: float, other: float) -> float:
    """Of all balls between two: a frustum between the circles where a cone touches both balls, and two caps."""
    lean = (one - other) / length
    steep = np.sqrt(1 - lean**2)

    def cap(radius: float, height: float) -> float:  # of a ball below `height` over its centre
        return float(np.pi * (radius**2 * height - height**3 / 3 + 2 * radius**3 / 3))

    height = length + (other - one) * lean
    frustum = np.pi * height / 3 * steep**2 * (one**2 + one * other + other**2)
    return float(frustum + cap(one, one * lean) + cap(other, -other * lean))


def lens_volume(one: float, other: float, apart: float) -> float:
    """Common to two balls (Weisstein, MathWorld: sphere-sphere intersection, eq. 16)."""
    square = apart**2 + 2 * apart * (one + other) - 3 * (one - other) ** 2
    return float(np.pi * (one + other - apart) ** 2 * square / (12 * apart))


BALLS = [4 / 3 * np.pi * r**3 for r in (12.0, 9.0)]
VOLUMES = {
    "ellipsoid": (made(EGG), 4 / 3 * np.pi * 20 * 15 * 10),
    "capsule": (made(ROD), np.pi * 64 * 20 + 4 / 3 * np.pi * 512),
    "tapered": (made(LIMB), tapered_volume(float(np.linalg.norm([8, -4, 22])), 7.0, 4.0)),
    "joined": (made(ball(12), ball(9, 13), rounding_mm=0.01), sum(BALLS) - lens_volume(12, 9, 13)),
    "carved": (made(ball(12), ball(9, 13, carve=True), rounding_mm=0.01), BALLS[0] - lens_volume(12, 9, 13)),
}


@cache
def blended(name: str) -> trimesh.Trimesh:
    """One of those, made once."""
    return blend(VOLUMES[name][0])


@pytest.mark.parametrize("name", VOLUMES)
def test_volume(name: str) -> None:
    """Vertices lie on the surface, so that chords miss a volume of the order of edge^2 / r^2."""
    mesh, volume = blended(name), VOLUMES[name][1]
    assert mesh.volume == pytest.approx(volume, rel=3e-3)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.euler_number == 2
    assert len(mesh.faces) == pytest.approx(TRIANGLES, rel=0.1)
    assert mesh.area_faces.std() < 0.3 * mesh.area_faces.mean()


def test_area_and_place() -> None:
    mesh = blended("capsule")
    assert mesh.area == pytest.approx(2 * np.pi * 8 * 20 + 4 * np.pi * 64, rel=2e-3)
    egg = blended("ellipsoid")
    turn = Rotation.from_euler("xyz", EGG["turn_deg"], degrees=True)
    own = turn.inv().apply(egg.vertices - np.array(EGG["centre_mm"]))
    np.testing.assert_allclose((own**2 / np.array(EGG["radii_mm"]) ** 2).sum(axis=1), 1, atol=1e-6)


def test_a_ring_of_capsules_has_a_hole() -> None:
    corner = [(14 * np.cos(t), 14 * np.sin(t), 0.0) for t in 2 * np.pi * np.arange(7) / 7]
    parts = [{"kind": "capsule", "from_mm": corner[i - 1], "to_mm": corner[i], "radius_mm": 5.0} for i in range(7)]
    mesh = blend(made(*parts))
    assert mesh.is_watertight
    assert mesh.euler_number == 0


def test_rounding_fills_the_notch_and_reaches_no_farther() -> None:
    """A polynomial minimum is lower by a quarter of the rounding where both are equal, and exact where they are not."""
    pair = ball(10), ball(10, 14)
    sharp, soft = blend_function(made(*pair, rounding_mm=1e-6)), blend_function(made(*pair, rounding_mm=2.0))
    between = np.array([[7.0, 0.0, float(np.sqrt(51))]])
    assert soft(between) - sharp(between) == pytest.approx(-0.5, abs=1e-6)
    apart = np.array([[-10.0, 0, 0], [24.0, 0, 0], [0, 0, 10.0]])
    np.testing.assert_allclose(soft(apart), sharp(apart), atol=1e-12)


def test_the_same_blend_gives_the_same_mesh() -> None:
    one, again = blended("capsule"), blend(made(ROD))
    assert np.array_equal(one.vertices, again.vertices)
    assert np.array_equal(one.faces, again.faces)


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "carved first": (lambda: made(ball(9, carve=True)), "nothing to carve"),
    "no part": (lambda: made(), "at least 1"),
    "one end in the other": (lambda: made(ROD | {"to_mm": (0, 0, -9), "to_radius_mm": 2.0}), "inside the other's ball"),
    "apart": (lambda: blend(made(ball(9), ball(9, 40))), "2 surfaces that do not touch"),
    "cavity": (lambda: blend(made(ball(9), ball(5, carve=True))), "2 surfaces.*carve from outside"),
    "all carved": (lambda: blend(made(ball(9), ball(12, carve=True))), "leaves nothing"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(name: str) -> None:
    make, message = REFUSED[name]
    with pytest.raises((ValueError, InputError), match=message):
        make()


@pytest.mark.parametrize("thickness", [0.05, 0.2, 0.4])
def test_a_sheet_as_thin_as_a_cell_is_refused(thickness: float) -> None:
    """Never a mesh with holes, or one whose two sides have met."""
    with pytest.raises(InputError, match=r"too thin for the mesh|thinner than") as caught:
        blend(made({"kind": "ellipsoid", "radii_mm": (20.0, 20.0, thickness)}))
    assert "\n" not in str(caught.value)


def test_a_sheet_of_some_cells_is_meshed_whole() -> None:
    mesh = blend(made({"kind": "ellipsoid", "radii_mm": (20.0, 20.0, 1.2)}))
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 400 * 1.2, rel=0.02)
