"""The estimators behind an image: connections, transmittance, projection, splats."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
import pytest
from bumpy_twin import F64, SPOT, VIEWS, blocks, bumpy
from numpy.typing import NDArray
from random_streams import streams
from significance import assert_z, z_of_difference, z_of_replicates
from twins import beam, block, camera, pixel_areas, twin

from disco_twin.evaluate.simulation_noise import splat_share
from disco_twin.light import connect
from disco_twin.light.connect import project, transmittance
from disco_twin.light.tables import medium_at
from disco_twin.light.transport import CameraLobe, Transport, camera_table
from disco_twin.object.build import Medium
from pipeline.geometry.camera import PinholeCamera, look_at

REPLICATES = 32


@pytest.mark.parametrize(("g", "alpha"), [(0.0, 0.3), (0.8, 0.3), pytest.param(0.0, 0.05, marks=pytest.mark.slow)])
def test_lobe_connection_is_unbiased(g: float, alpha: float) -> None:
    """Rationale: lobe connections and exits share each path by the balance heuristic; a density that is wrong, or used
    in one technique only, moves energy.

    Expected behaviour: with lobes, images equal those of plain exits (reach 0) in every block of pixels, in both
    layers, in total, and the noise is lower.
    """
    obj = bumpy(alpha=alpha, g=g)
    views = [camera(place, 13.0, 24) for place in VIEWS]
    images = []
    # The smoother, the rarer and the brighter the exits towards a camera, and the later their sums are normal.
    few, many = (2_000, 12_000) if alpha > 0.1 else (4_000, 40_000)
    for lobe, walks in ((None, few), (CameraLobe(100.0, 0.0, 0.0), many)):
        transport = Transport(obj, cells=64, lobe=lobe)
        traced = transport.trace(beam(REPLICATES, **SPOT), REPLICATES, walks, seed=71, cameras=views, layers=2)
        assert traced.images is not None
        images.append(traced.images[:, :, :, 0].astype(float))
    plain = images[1]
    cut = [blocks(i, 6) for i in images]
    busy = blocks((plain > 0).mean(axis=0), 6) > 4  # enough hits for a normal error
    assert busy.sum() > 20
    assert_z(z_of_difference(cut[0][:, busy], cut[1][:, busy]), f"blocks, g = {g}, alpha = {alpha}")
    total = [i.sum(axis=(-1, -2)) for i in images]
    assert_z(z_of_difference(*total), f"layers and cameras, g = {g}, alpha = {alpha}")
    per_walk = [t[:, 0].var(axis=0, ddof=1) * n for t, n in zip(total, (few, many), strict=True)]
    assert np.all(per_walk[0] < per_walk[1] / 2)


@pytest.mark.parametrize("kind", ["rough", pytest.param("matched", marks=pytest.mark.slow)])
def test_many_cameras_are_drawn_from(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rationale: of many cameras each connection reaches a few, whose contributions count for the others.

    Expected behaviour: seven cameras, two of them drawn, show what all seven show when every one is reached, block by
    block of pixels.
    """
    obj = bumpy(kind)
    places = [(350 * math.cos(a), 350 * math.sin(a), 60.0 * (-1) ** k) for k, a in enumerate(np.arange(7) * 0.9)]
    views = [camera(place, 13.0, 16) for place in places]
    transport = Transport(obj, cells=64)
    images = []
    for most, walks, seed in ((2, 6_000, 75), (7, 3_000, 76)):
        monkeypatch.setattr(connect, "MOST_CAMERAS", most)
        traced = transport.trace(beam(REPLICATES, **SPOT), REPLICATES, walks, seed=seed, cameras=views)
        assert traced.images is not None
        images.append(traced.images[:, 0, :, 0].astype(float))
    busy = blocks((images[0] > 0).mean(axis=0), 4) > 4
    assert busy.sum() > 40
    assert_z(z_of_difference(*[blocks(i, 4)[:, busy] for i in images]), f"{kind}: blocks")
    assert_z(z_of_difference(*[i.sum(axis=(-1, -2)) for i in images]), f"{kind}: cameras")


def test_cameras_see_what_leaves() -> None:
    """Rationale: the known answers through a camera hold for a matched boundary; behind a rough one the connection goes
    through refraction, factors of eta^2, shadowing and the lobe.

    Expected behaviour: radiance over a half-space, times cosine, integrated over the hemisphere of directions by eight
    distant cameras (Gauss-Legendre in the squared cosine), is the power that leaves by the walk's own tally.
    """
    x, w = np.polynomial.legendre.leggauss(8)
    mu, w = np.sqrt((x + 1) / 2), w / 2
    transport = Transport(twin(block(80.0, 20.0), "rough", 1.3, 10.0, [0.9, 0.99]), cells=64)
    turns = 2.4 * np.arange(len(mu))
    places = 3000 * np.stack([np.sqrt(1 - mu**2) * np.cos(turns), np.sqrt(1 - mu**2) * np.sin(turns), mu], axis=1)
    views = [camera(place, 40.0, 15) for place in places]
    make = beam(REPLICATES, origin=(0.02, -0.01, 50.0))
    traced = transport.trace(make, REPLICATES, 3_000, seed=72, cameras=views, layers=2, deposit=True)
    assert traced.images is not None
    assert traced.deposits is not None
    area = np.stack([pixel_areas(view) for view in views])
    seen = math.pi * np.einsum("c,tclhw,chw->tl", w, traced.images[:, 0].astype(float), area)
    assert_z(z_of_replicates(seen - traced.deposits.sum(axis=2)), "seen - left")
    assert np.all(seen.std(axis=0) / seen.mean(axis=0) / math.sqrt(REPLICATES) < 0.01)


def test_transmittance_is_unbiased() -> None:
    """Rationale: ratio tracking through a grid of which one voxel is drawn per look-up.

    Expected behaviour: its mean is exp(-integral of the trilinear sigma_t) by float64 quadrature, along 48 segments
    that also leave the grid (clamped).
    """
    obj = bumpy()
    tables = Transport(obj, cells=32)._tables((0,))
    random = np.random.default_rng(4)
    a = random.uniform(-6, 6, (48, 3))
    b = a + random.uniform(-1, 1, (48, 3))  # short, or the mean is made by a few of the samples
    n = 1 << 14
    rng = streams(seed=9, n=48 * n)
    start = mi.Point3f(np.repeat(a, n, axis=0).T.astype(np.float32))
    direction, length = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True), np.linalg.norm(b - a, axis=1)
    value, _ = transmittance(
        tables, start, mi.Vector3f(np.repeat(direction, n, axis=0).T.astype(np.float32)),
        mi.Float(np.repeat(length, n).astype(np.float32)), rng,
    )  # fmt: skip
    value = np.array(value, np.float64).reshape(48, n)
    steps = (np.arange(4000) + 0.5) / 4000
    exact = [
        math.exp(-trilinear(obj.medium, obj.medium.sigma_t[0], p + (q - p) * steps[:, None]).mean() * s)
        for p, q, s in zip(a, b, length, strict=True)
    ]
    assert_z((value.mean(axis=1) - exact) / (value.std(axis=1, ddof=1) / math.sqrt(n)), "segments")


def trilinear(medium: Medium, values: NDArray[np.float32], points: F64) -> F64:
    """(N,) values (nz, ny, nx) of cell centres interpolated at (N, 3) points, clamped at the rim; plain float64."""
    shape = np.array(values.shape[::-1])
    grid = (points - medium.low) / (np.asarray(medium.high) - medium.low) * shape - 0.5
    base = np.floor(grid).astype(int)
    part = grid - base
    out = np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        index = np.clip(base + corner, 0, shape - 1)
        weight = np.prod(np.where(np.array(corner) == 1, part, 1 - part), axis=1)
        out += weight * values[index[:, 2], index[:, 1], index[:, 0]].astype(float)
    return out


def test_medium_is_trilinear_in_the_mean() -> None:
    """The drawn voxel's sigma_t and sigma_s = albedo * sigma_t have the trilinear interpolants as their means."""
    obj = bumpy()
    tables = Transport(obj, cells=32)._tables((0,))
    points = np.random.default_rng(5).uniform(-5.5, 5.5, (40, 3))
    n = 1 << 14
    chance, albedo, _ = medium_at(
        tables, mi.Point3f(np.repeat(points, n, axis=0).T.astype(np.float32)), streams(seed=10, n=40 * n)
    )
    sigma_t = np.array(chance, np.float64).reshape(40, n) * float(obj.medium.sigma_t.max())
    sigma_s = sigma_t * np.array(albedo[0], np.float64).reshape(40, n)
    for drawn, values in ((sigma_t, obj.medium.sigma_t[0]), (sigma_s, (obj.medium.sigma_t * obj.medium.albedo)[0])):
        error = drawn.std(axis=1, ddof=1) / math.sqrt(n) + 1e-6  # in the clamped corners there is but one voxel
        assert_z((drawn.mean(axis=1) - trilinear(obj.medium, values, points)) / error, "medium")


def test_projection_is_the_cameras() -> None:
    """Rationale: splats use the lens of the pipeline's camera, distortion included, and its pixels' solid angles.

    Expected behaviour: pixel and visibility are those of `PinholeCamera.project`; the factor is one over distance^2
    times the pixel's solid angle, which finite differences of that projection give in float64.
    """
    pose = look_at((300.0, 80.0, 120.0), (1.0, -2.0, 3.0))
    view = PinholeCamera(
        64, 40, np.array([420.0, 410.0]), np.array([31.0, 21.5]), np.array([-0.2, 0.1, 0.004, -0.003, 0.05]), pose
    )
    points = np.random.default_rng(6).uniform(-28, 28, (20_000, 3))
    table = camera_table([view])
    _, towards, pixel, factor, inside = project(table, mi.UInt32(0), mi.Point3f(points.T.astype(np.float32)))
    where, depth = view.project(points)
    expected = (where >= 0).all(axis=1) & (where < [64, 40]).all(axis=1) & (depth > 0)
    near = np.abs(where - np.round(where)).min(axis=1) < 1e-3  # a pixel's edge: single precision decides
    visible = np.array(inside)
    assert np.array_equal(visible[~near], expected[~near])
    assert 1000 < visible.sum() < 19_000
    used = visible & expected & ~near
    index = np.floor(where[used]).astype(int)
    assert np.array_equal(np.array(pixel)[used], index[:, 1] * 64 + index[:, 0])
    offset = view.position - points
    squared = (offset**2).sum(axis=1)
    assert np.abs(np.array(towards).T - offset / np.sqrt(squared)[:, None]).max() < 1e-6
    unit = offset / np.sqrt(squared)[:, None]
    side = np.cross(unit, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(unit, side)
    step = 1e-3
    da, db = (view.project(points + step * s)[0] - view.project(points - step * s)[0] for s in (side, up))
    # Pixels per square millimetre across the line of sight.
    exact = np.abs(da[:, 0] * db[:, 1] - da[:, 1] * db[:, 0]) / (2 * step) ** 2
    assert np.abs(np.array(factor)[used] / exact[used] - 1).max() < 1e-3


@pytest.mark.parametrize(
    ("kind", "alpha", "g"),
    [("rough", 0.3, 0.0), ("rough", 0.05, 0.0), ("rough", 0.02, 0.0), ("rough", 0.25, 0.8), ("matched", 0.0, 0.4)],
)
def test_a_walk_adds_a_splat_of_known_radiance(kind: str, alpha: float, g: float) -> None:
    """Rationale: `disco-twin plan` says from it how many walks a scene takes.

    Expected behaviour: variance of a pixel x walks / mean, between replicates, is within a factor of two (three
    where light scatters forward or the boundary is as smooth as a scene may have it) of `splat_share`, in each of the
    three decades below the brightest pixel.
    """
    view = camera(VIEWS[0], 13.0, 48)
    walks, replicates = 4_000, 64
    transport = Transport(bumpy(kind, alpha=alpha, g=g), cells=64)
    images = transport.trace(beam(replicates, **SPOT), replicates, walks, seed=73, cameras=[view]).images  # type: ignore[arg-type]
    assert images is not None
    found = images[:, 0, 0, 0].astype(float)
    mean, variance = found.mean(axis=0), found.var(axis=0, ddof=1)
    unit = float(view.focal.prod() / (view.position @ view.position))
    within = 2.0 if g < 0.5 and alpha != 0.02 else 3.0
    for decade in range(3):
        part = (mean <= mean.max() * 10.0**-decade) & (mean > mean.max() * 10.0 ** -(decade + 1))
        assert part.sum() >= 5
        share = variance[part].sum() * walks / mean[part].sum() / unit
        expected = splat_share(alpha if kind == "rough" else None, 1.3, g)
        assert 1 / within < share / expected < within, f"decade -{decade}: {share:.3f}"


def test_a_camera_of_many_gets_larger_splats() -> None:
    """Rationale: of many cameras six are drawn, and each counts for several; `plan` must know.

    Expected behaviour: with 24 cameras the variance of a walk, over the mean, is 24 / 6 that with six, within a third.
    """
    views = [camera(VIEWS[0], 13.0, 24)] * 24
    transport = Transport(bumpy(g=0.0), cells=64)
    share = []
    for count in (6, 24):
        images = transport.trace(beam(64, **SPOT), 64, 1_500, seed=74, cameras=views[:count]).images  # type: ignore[arg-type]
        assert images is not None
        found = images[:, 0, :, 0].astype(float)
        mean, variance = found.mean(axis=(0, 1)), found.var(axis=0, ddof=1).mean(axis=0)
        bright = mean > mean.max() * 0.1
        share.append(variance[bright].sum() / mean[bright].sum())
    assert share[1] / share[0] == pytest.approx(4.0, rel=1 / 3)
