"""What flights rest on: the distance field, samples of the surface, local majorants."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import drjit as dr
import gpytoolbox
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from bumpy_twin import SPOT, bumpy
from numpy.typing import NDArray
from significance import assert_z, z_of_difference
from twins import beam, twin

from disco_twin.light.distance import NEAR, DistanceField, build_distance_field, sample_surface
from disco_twin.light.importance import Splitting
from disco_twin.light.majorants import local_majorants
from disco_twin.light.sampling import Rng
from disco_twin.light.sources import opaque3, to_float
from disco_twin.light.tables import free_flight, medium_at, surroundings
from disco_twin.light.transport import Transport
from disco_twin.object import shapes
from disco_twin.object.build import Medium, TwinObject
from disco_twin.scene.shape_schema import Pebble

F64 = NDArray[np.float64]
REPLICATES = 32


SURFACES = {
    "pebble": lambda: shapes.pebble(Pebble(kind="pebble")),
    "plate": lambda: trimesh.creation.box(extents=[30.0, 20.0, 0.05]),
    "torus": lambda: trimesh.creation.torus(5.0, 2.0, major_sections=48, minor_sections=24),
    "soup": lambda: trimesh.Trimesh(
        np.random.default_rng(8).normal(size=(90, 3)) * [9.0, 3.0, 1.0], np.arange(90).reshape(30, 3), process=False
    ),
}


@pytest.mark.parametrize("surface", sorted(SURFACES))
def test_distance_field_is_a_lower_bound(surface: str) -> None:
    """Rationale: a flight is not tested against the surface if the field vouches for it; one cell that claims too much
    lets light through walls.

    Expected behaviour: at points anywhere, next to the surface, and outside the grid, the ball that the walk takes is
    at most the exact distance, and at least that less four cells; beside the surface less one cell's diagonal.
    """
    mesh = SURFACES[surface]()
    field = build_distance_field(mesh, 64)
    random = np.random.default_rng(9)
    low, high = np.asarray(mesh.bounds, float)
    reach = field.cell * field.cells / 2
    everywhere = (low + high) / 2 + random.uniform(-1.1 * reach, 1.1 * reach, (20_000, 3))
    samples, _ = sample_surface(mesh, 4 * field.cell)
    pick = random.integers(len(samples), size=20_000)
    beside = samples[pick] + random.normal(size=(20_000, 3)) * random.choice([0.01, 0.5, 2.0], (20_000, 1)) * field.cell
    points = np.concatenate([everywhere, beside])
    corners, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int32)
    exact = np.sqrt(gpytoolbox.squared_distance(points, corners, faces, use_cpp=True)[0])
    ball, _ = surroundings(field_tables(field), mi.Point3f(points.T.astype(np.float32)))
    value = np.array(ball, float)
    assert np.all(value <= exact), f"{np.max(value - exact):.3g} mm too much"
    covered = (np.abs(points - (low + high) / 2) < reach - field.cell).all(axis=1)
    if mesh.is_watertight:
        covered &= mesh.contains(points)
        beside = covered & (exact < (NEAR - 1) * field.cell)
        assert beside.sum() > 100
        assert np.all(value[beside] >= exact[beside] - np.sqrt(3.0) * field.cell)
    assert np.all(value[covered] >= exact[covered] - 4 * field.cell)


def field_tables(field: DistanceField) -> Any:
    """As much of the walk's tables as `surroundings` reads."""
    return SimpleNamespace(
        low=opaque3(mi.Point3f, field.low), inverse_cell=dr.opaque(mi.Float, 1 / field.cell), cells=field.cells,
        distance=to_float(field.distance), local=False, majorant=mi.Float(1.0),
    )  # fmt: skip


@pytest.mark.parametrize("surface", ["torus", "soup"])
def test_surface_samples_leave_no_gap(surface: str) -> None:
    """No point of the surface is farther than the spacing from a sample of its own face."""
    mesh = SURFACES[surface]()
    spacing = 0.4
    samples, faces = sample_surface(mesh, spacing)
    random = np.random.default_rng(10)
    for face in random.integers(len(mesh.faces), size=60):
        b = random.dirichlet([1.0, 1.0, 1.0], 200)
        points = b @ np.asarray(mesh.triangles[face], float)
        own = samples[faces == face]
        nearest = np.linalg.norm(points[:, None] - own[None], axis=2).min(axis=1)
        assert nearest.max() <= spacing


def veined(side: int = 40) -> TwinObject:
    """The bumpy body with a dense, dark sheet in a thin medium, and single dense voxels."""
    obj = bumpy()
    low, high = obj.medium.low, obj.medium.high
    x = (np.arange(side) + 0.5) / side
    sigma_t = np.full((1, side, side, side), 0.8, np.float32)
    sigma_t[0, :, :, np.abs(x - 0.55) < 0.03] = 4.0
    sigma_t[0][np.random.default_rng(3).random((side,) * 3) < 2e-4] = 6.0
    albedo = np.where(sigma_t > 1, 0.8, 0.999).astype(np.float32)
    return replace(obj, medium=Medium(sigma_t, albedo, low, high, (0.0,)))


def test_local_majorants_are_nowhere_exceeded() -> None:
    """Rationale: where sigma_t exceeds the majorant, collisions are lost, and nothing shows it but the image.

    Expected behaviour: from any place inside, at the end of any flight that may collide, the walk's look-up of sigma_t
    (drawn anew fifty times) stays within the rate of the place where the flight began; some come within 1 %.
    """
    transport = Transport(veined(), cells=64)
    tables = transport._tables((0,))
    assert tables.local
    random = np.random.default_rng(4)
    start = transport.vertices[random.integers(len(transport.vertices), size=20_000)]
    start = start * random.uniform(0.1, 0.98, (20_000, 1)) + random.normal(size=start.shape) * 0.01
    direction = random.normal(size=start.shape)
    direction[::5, 1:] = 0.0  # along an axis, where the cube is nearest
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    p, d = (mi.Point3f(x.T.astype(np.float32)) for x in (start, direction))
    _, rate = surroundings(tables, p)
    number = dr.arange(mi.UInt32, 20_000)
    rng = Rng.of(mi.UInt32(5), dr.zeros(mi.UInt32, 20_000), number)
    closest = 0.0
    for _ in range(50):
        flight, bound = free_flight(tables, d, rate * 0.1, rng)  # long ones, to be cut
        end = p + d * dr.minimum(flight, 0.999_999 * flight)
        chance, _, _ = medium_at(tables, end, rng)
        share = chance * tables.majorant / rate
        dr.eval(share, bound, rng.s0, rng.s1)  # or each draw repeats all before
        share = np.array(share)
        assert share.max() <= 1.0 + 1e-6
        closest = max(closest, float(share.max()))
        assert np.isinf(np.array(bound)).any()
    assert closest > 0.99


def test_local_majorants_change_no_light() -> None:
    """Rationale: they decide about time alone.

    Expected behaviour: deposits in forty groups of vertices, with and without splitting, are those under one majorant.
    """
    found = []
    for local in (True, False):
        transport = Transport(veined(), cells=64, local=local)
        entry = np.tile(np.array(SPOT["origin"]) + 41.0 * np.array(SPOT["direction"]), (REPLICATES, 1))
        order = np.array_split(np.argsort(transport.vertices @ [1.0, 0.3, 0.2]), 40)
        for split in (None, Splitting(entry, 3.0)):
            traced = transport.trace(beam(REPLICATES, **SPOT), REPLICATES, 6_000, seed=7, deposit=True, split=split)  # type: ignore[arg-type]
            assert traced.deposits is not None
            found.append(np.stack([traced.deposits[:, 0, i].sum(axis=1) for i in order], axis=1))
    assert_z(z_of_difference(found[0], found[2]), "without splitting")
    assert_z(z_of_difference(found[1], found[3]), "with splitting")


def test_local_majorants_are_left_out_where_they_save_nothing() -> None:
    """A homogeneous object needs none, nor one whose densest voxels lie everywhere."""
    assert not Transport(twin(trimesh.creation.icosphere(), "rough", 1.3, 1.0, [0.9]))._tables((0,)).local
    assert not Transport(bumpy(), cells=64)._tables((0,)).local
    dense = np.ones((8, 8, 8))
    inside = np.argwhere(np.ones((16, 16, 16), bool))
    assert local_majorants(dense, np.zeros(3), np.full(3, 8.0), np.zeros(3), 0.5, 16, inside) is None
    dense[0] = 9.0
    assert local_majorants(dense, np.zeros(3), np.full(3, 8.0), np.zeros(3), 0.5, 16, inside) is not None
    assert local_majorants(dense, np.zeros(3), np.full(3, 8.0), np.zeros(3), 0.5, 16, inside[:0]) is None
