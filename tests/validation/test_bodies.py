"""Bodies inside the object: cavities, inclusions, what lies inside them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import nested_walk
import numpy as np
import pytest
import trimesh
from bumpy_twin import SPOT, VIEWS, blocks, bumpy
from nested_walk import Ball, Brick, Region
from numpy.typing import NDArray
from significance import assert_z, z_of_difference, z_of_replicates
from twins import beam, camera, twin

from disco_twin.light.importance import Splitting
from disco_twin.light.sources import light_source
from disco_twin.light.transport import CameraLobe, Traced, Transport
from disco_twin.object.bodies import OBJECT, Body, OwnMedium, Wall
from disco_twin.object.build import TwinBoundary, TwinObject
from pipeline.geometry.fresnel import mean_transmittance
from pipeline.relight.lights import Uniform

F64 = NDArray[np.float64]
REPLICATES = 32


def ball(radius: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0), fine: int = 3) -> trimesh.Trimesh:
    """An icosphere of the volume of its ball."""
    mesh = trimesh.creation.icosphere(subdivisions=fine, radius=radius)
    mesh.apply_scale((4 / 3 * math.pi * radius**3 / mesh.volume) ** (1 / 3))
    mesh.apply_translation(at)
    return mesh


def brick(low: tuple[float, ...], high: tuple[float, ...]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=np.array([low, high], float))


def nest(regions: list[Region], fine: int) -> TwinObject:
    """The same regions as meshes, with smooth walls."""

    def mesh(region: Region) -> trimesh.Trimesh:
        shape = region.shape
        return (
            ball(shape.radius, tuple(shape.centre), fine) if isinstance(shape, Ball) else brick(shape.low, shape.high)
        )

    outer, *inner = regions
    obj = twin(mesh(outer), "smooth", outer.eta, outer.sigma_t, outer.albedo, outer.g)
    bodies = []
    for region in inner:
        lasers = len(region.albedo)
        own = OwnMedium((region.sigma_t,) * lasers, tuple(region.albedo), (region.g,) * lasers)
        wall = Wall.of(region.eta, regions[region.around].eta, 0.0)
        bodies.append(Body(mesh(region), region.around + OBJECT, wall, own if region.sigma_t else None))
    return replace(obj, inside=tuple(bodies))


# A plate with an air gap, in it a plate of another index that scatters, in that a bubble; an absorbing one beside it.
PLATES = [
    Region(Brick((-6, -6, -4), (6, 6, 0)), -1, 1.4, 1.5, (0.99, 0.9), 0.5),
    Region(Brick((-5, -5, -3.2), (2, 5, -0.8)), 0, 1.0, 0.0, (0.0, 0.0)),
    Region(Brick((-4.5, -4.5, -2.6), (1.5, 4.5, -1.2)), 1, 1.6, 1.0, (0.98, 0.95), -0.3),
    Region(Brick((-3, -3, -2.2), (0, 3, -1.6)), 2, 1.0, 0.0, (0.0, 0.0)),
    Region(Brick((3, -3, -3), (5, 3, -1)), 0, 1.2, 2.0, (0.3, 0.6)),
]
# A hollow ball, and a ball in its cavity.
SHELL = [
    Region(Ball((0, 0, 0), 5.0), -1, 1.3, 2.0, (0.995, 0.95), 0.6),
    Region(Ball((0, 0, 0), 3.8), 0, 1.0, 0.0, (0.0, 0.0)),
    Region(Ball((0, 0, 0), 2.0), 1, 1.3, 1.0, (0.9, 0.99)),
]


@pytest.mark.parametrize(
    ("regions", "fine", "walks"), [(PLATES, 0, 3_000), pytest.param(SHELL, 6, 20_000, marks=pytest.mark.slow)]
)
def test_nested_bodies(regions: list[Region], fine: int, walks: int) -> None:
    """Rationale: refraction and total reflection at walls inside, in both directions; media of their own, clear and
    absorbing bodies, three walls deep. The icospheres of the hollow ball differ from balls by 4e-4 of a normal.

    Expected behaviour: of a beam 4 mm wide, the power that leaves and its first moments over the surface are those of
    an independent walk in double precision with analytic surfaces, at two wavelengths; nothing is lost.
    """
    transport = Transport(nest(regions, fine), cells=64)
    axis = np.array([-0.1, 0.2, -1.0]) / np.linalg.norm([-0.1, 0.2, -1.0])
    make = beam(REPLICATES, origin=(1.5, -2.3, 10.0), direction=axis, radius=2.0)
    traced = transport.trace(make, REPLICATES, walks, seed=91, deposit=True)
    assert np.abs(traced.balance.residual).max() < 1e-6
    assert np.all(traced.balance.inside < 1e-5)
    assert traced.deposits is not None
    weights = np.column_stack([np.ones(len(transport.vertices)), transport.vertices])
    found = traced.deposits @ weights  # (replicates, L, 4): hats keep linear functions
    random = np.random.default_rng(92)
    count = REPLICATES * walks
    r, turn = 2.0 * np.sqrt(random.random(count)), 2 * np.pi * random.random(count)
    s = np.cross(axis, [1.0, 0, 0])
    s /= np.linalg.norm(s)
    disc = np.outer(r * np.cos(turn), s) + np.outer(r * np.sin(turn), np.cross(axis, s))
    start = disc + np.array([1.5, -2.3, 10.0])
    place, power = nested_walk.walk(regions, start, np.tile(axis, (count, 1)), seed=93)
    moments = power[:, :, None] * np.column_stack([np.ones(count), place])[:, None, :]
    expected = moments.reshape(REPLICATES, walks, *moments.shape[1:]).mean(axis=1)
    assert_z(z_of_difference(found, expected), "power and moments of both wavelengths")


def test_equilibrium_with_bodies_inside() -> None:
    """Rationale: in even light from everywhere an object that absorbs nothing is in equilibrium whatever lies inside.

    Expected behaviour: what leaves through each octant of the outer surface is pi * radiance * Tbar(eta) * area.
    """
    mesh = ball(4.0, fine=3)
    own = OwnMedium((1.5,), (1.0,), (-0.5,))
    bodies = (
        Body(ball(2.4, (0.5, 0.2, 0.0)), OBJECT, Wall.of(1.0, 1.4, 0.0), None),
        Body(trimesh.creation.torus(1.0, 0.4, major_sections=32, minor_sections=16), 2, Wall.of(1.4, 1.0, 0.0), True),
        Body(ball(0.5, (-2.8, 0.0, 0.3)), OBJECT, Wall.of(1.7, 1.4, 0.0), own),
        Body(ball(0.4, (0.0, -3.1, 0.0)), OBJECT, Wall.of(1.4, 1.4, 0.0), own),
    )
    obj = replace(twin(mesh, "smooth", 1.4, 1.0, [1.0], 0.3), inside=bodies)
    transport = Transport(obj, cells=64)
    light = Uniform(radiance=1.0)
    traced = transport.trace(
        lambda group: light_source(light, transport.radius, group), REPLICATES, 10_000, seed=94, deposit=True
    )
    assert np.abs(traced.balance.residual).max() < 1e-6
    assert traced.balance.absorbed[0] == 0
    assert traced.deposits is not None
    area = np.bincount(mesh.faces.ravel(), np.repeat(mesh.area_faces / 3, 3), minlength=len(mesh.vertices))
    patch = (np.asarray(mesh.vertices) > 1e-9) @ [1, 2, 4]
    power = np.stack([traced.deposits[:, 0, patch == k].sum(axis=1) for k in range(8)], axis=1)
    expected = math.pi * np.array([area[patch == k].sum() for k in range(8)]) * mean_transmittance(1.4)
    assert_z(z_of_replicates(power, expected), "octants")


def hollow() -> TwinObject:
    """The body with bumps, a rough cavity near its surface and an inclusion in the cavity."""
    return replace(
        bumpy(),
        inside=(
            Body(ball(2.2, (1.2, 0.0, 0.6)), OBJECT, Wall.of(1.0, 1.3, 0.3), None),
            Body(ball(1.0, (1.0, 0.0, 0.6)), 2, Wall.of(1.3, 1.0, 0.3), True),
        ),
    )


def spot(obj: TwinObject, walks: int, seed: int, lobe: CameraLobe | None = None, **key: Any) -> tuple[F64, Traced]:
    """(replicates, C, H, W) images of a spot."""
    views = [camera(place, 13.0, 24) for place in VIEWS]
    transport = Transport(obj, cells=64, lobe=lobe)
    traced = transport.trace(beam(REPLICATES, **SPOT), REPLICATES, walks, seed=seed, cameras=views, deposit=True, **key)
    assert traced.images is not None
    assert np.abs(traced.balance.residual).max() < 1e-6
    return traced.images[:, 0, :, 0].astype(float), traced


def assert_alike(one: F64, other: F64, label: str) -> None:
    busy = blocks((other > 0).mean(axis=0), 6) > 4
    assert busy.sum() > 10
    assert_z(z_of_difference(*[blocks(i, 6)[:, busy] for i in (one, other)]), f"{label}: blocks")
    assert_z(z_of_difference(*[i.sum(axis=(-1, -2)) for i in (one, other)]), f"{label}: cameras")


def test_a_body_is_a_shell_of_the_mesh() -> None:
    """Rationale: rough walls, which the independent walk has not: light is connected to cameras, by lobes or at exits,
    only where it leaves the object.

    Expected behaviour: images of a cavity and of a body in it are those of the same shells as parts of the one mesh
    that the walk knew before there were bodies, with exits alone; the power that leaves the outer surface is the same.
    """
    obj = hollow()
    cavity = obj.inside[0].mesh.copy()
    cavity.invert()
    mesh = trimesh.util.concatenate([obj.mesh, cavity, obj.inside[1].mesh])
    assert isinstance(obj.boundary, TwinBoundary)
    one, traced = spot(obj, 800, 95)
    other, whole = spot(TwinObject(mesh, obj.boundary, obj.medium), 4_000, 96, CameraLobe(100.0, 0.0, 0.0))
    assert_alike(one, other, "shells")
    outer = len(obj.mesh.vertices)
    assert traced.deposits is not None and whole.deposits is not None
    assert traced.deposits.shape[2] == outer
    assert_z(z_of_difference(traced.deposits.sum(axis=2), whole.deposits[..., :outer].sum(axis=2)), "power")


@pytest.mark.slow
def test_copies_know_their_region() -> None:
    """Rationale: copies of a split photon wait, in a body of another medium too, and are walked on from there.

    Expected behaviour: with weight windows the spot looks as without, and so does the power that leaves, by octants.
    """
    own = OwnMedium((3.0,), (0.5,), (0.0,))
    obj = replace(bumpy(), inside=(Body(ball(2.5, (-1.2, 0.0, -0.6)), OBJECT, Wall.of(1.5, 1.3, 0.0), own),))
    one, plain = spot(obj, 6_000, 97)
    entry = np.tile([[4.2, 0.0, 1.8]], (REPLICATES, 1))
    other, split = spot(obj, 1_500, 98, split=Splitting(entry))
    assert_alike(other, one, "windows")
    patch = (np.asarray(obj.mesh.vertices) > 0) @ [1, 2, 4]
    assert plain.deposits is not None and split.deposits is not None
    parts = [np.stack([t.deposits[:, 0, patch == k].sum(axis=1) for k in range(8)], axis=1) for t in (split, plain)]  # type: ignore[index]
    assert_z(z_of_difference(*parts), "octants")


def test_no_camera_sees_through_walls_without_a_boundary() -> None:
    obj = replace(twin(ball(4.0), "matched", 1.0, 1.0, [0.9]), inside=hollow().inside[:1])
    with pytest.raises(ValueError, match="without a boundary"):
        Transport(obj, cells=32).trace(beam(), 1, 10, seed=1, cameras=[camera((300.0, 0.0, 0.0), 13.0, 16)])
