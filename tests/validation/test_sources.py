"""Rationale: the sources turn densities and radiometry into photons; what they launch is checked against the lights'
own definitions in pipeline/relight/lights.py, in NumPy.

Expected behaviour: positions and directions follow their densities (chi-squared at 0.1 %); the power that a region of
directions or positions receives is the integral of the light's radiance or intensity over it (z-scores from the
photons' own weights).
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray
from random_streams import N, azimuth, streams
from significance import assert_chi_squared, assert_uniform, assert_z

from disco_twin.light.sources import BeamSource, HatSource, Source, light_source
from pipeline.relight.lights import Beam, Directional, Environment, Lobe, TexturedProjector, Uniform

F64 = NDArray[np.float64]
RADIUS = 25.0


def launch(source: Source, tag: int = 0, seed: int = 5, n: int = N) -> tuple[F64, F64, F64]:
    """Positions (n, 3), directions (n, 3) and weights (n, L) of n photons."""
    rng = streams(seed=seed, n=n)
    p, d, w = source.launch(rng, dr.full(mi.UInt32, tag, n), mi.Bool(True))
    w = w + dr.zeros(type(w), n)
    d = d + dr.zeros(mi.Vector3f, n)
    position, direction = np.array(p, np.float64).T, np.array(d, np.float64).T
    assert np.abs(np.linalg.norm(direction, axis=1) - 1).max() < 1e-5
    return position + np.zeros((n, 1)), direction, np.atleast_2d(np.array(w, np.float64)).T


def assert_power(weight: F64, cell: NDArray[np.int64], expected: F64, label: str) -> None:
    """weight: (n,) of each photon; cell: (n,) index into `expected` (K,), the power that each cell should receive.

    Tested in each cell, in rows of cells, and in total: a small error everywhere shows in the larger sums.
    """
    n, count = len(weight), len(expected)
    for width in (1, round(math.sqrt(count)), count):
        groups = -(-count // width)
        total = np.bincount(cell // width, weight, minlength=groups) / n
        square = np.bincount(cell // width, weight**2, minlength=groups) / n
        power = np.add.reduceat(expected, np.arange(0, count, width))
        rounding = 1e-5 * power  # perfect importance sampling leaves the total no variance at all
        error = np.sqrt(np.maximum(square - total**2, 0) / n + rounding**2)
        used = power > 1e-4 * power.max()
        assert_z((total - power)[used] / error[used], f"{label}, cells of {width}")


def test_beams_are_discs_along_their_axes() -> None:
    """Uniform and Gaussian profiles of radius 1.5 mm; each tag has its own axis, the whole power is in every photon."""
    origins = np.array([[0, 0, 300.0], [400.0, 30.0, -20.0]])
    directions = np.array([[0, 0, -1.0], [-0.8, 0.36, 0.48]])
    power = np.array([[1.0, 2.0, 3.0], [0.5, 0.25, 0.125]])
    for profile in ("uniform", "gaussian"):
        source = BeamSource(origins, directions, 1.5, power, profile)
        for tag in (0, 1):
            position, direction, weight = launch(source, tag)
            assert np.abs(direction - directions[tag]).max() < 1e-6
            assert np.abs(weight - power[tag]).max() < 1e-6
            offset = (position - origins[tag]) / 1.5
            assert np.abs(offset @ directions[tag]).max() < 1e-4
            unit = offset + directions[tag] * 1e-30
            r2 = (unit**2).sum(axis=1)
            _, turn = azimuth(unit, directions[tag])
            radial = r2 if profile == "uniform" else -np.expm1(-2 * r2)
            assert_uniform(np.column_stack([np.minimum(radial, 1.0), turn]), f"{profile} {tag}")


def test_hat_source_follows_its_hats() -> None:
    """Faces in proportion to the integral of the hat, places inside a face to the hat, directions to the cosine.

    Every face is cut into four; the integral of a linear function over a sub-triangle is its area times the mean of
    its three corner values.
    """
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=3.0)
    vertices, faces = np.asarray(mesh.vertices) * [1.0, 1.3, 0.7], np.asarray(mesh.faces, np.int64)
    hats = np.zeros((3, len(vertices)))
    hats[0, 4] = 1.0
    hats[1, [0, 7, 12]] = 1.0, 0.5, 0.2
    hats[2] = np.random.default_rng(3).uniform(0, 1, len(vertices))
    source = HatSource(vertices, faces, hats, 2)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area, normal = np.linalg.norm(cross, axis=1) / 2, cross / np.linalg.norm(cross, axis=1, keepdims=True)
    corner = np.array([[[2, 0, 0], [1, 1, 0], [1, 0, 1]], [[1, 1, 0], [0, 2, 0], [0, 1, 1]],
                       [[1, 0, 1], [0, 1, 1], [0, 0, 2]], [[1, 1, 0], [0, 1, 1], [1, 0, 1]]]) / 2  # fmt: skip
    for tag, hat in enumerate(hats):
        n = N // 4
        position, direction, weight = launch(source, tag, n=n)
        assert np.all(weight == 1.0)
        # The face: the one whose plane and whose barycentrics hold the point best.
        best, where, part = np.full(n, np.inf), np.zeros(n, int), np.zeros(n, int)
        for f in np.flatnonzero(hat[faces].sum(axis=1)):
            relative = position - a[f]
            height = relative @ normal[f]
            b2 = np.cross(b[f] - a[f], relative) @ normal[f] / (2 * area[f])
            b1 = np.cross(relative, c[f] - a[f]) @ normal[f] / (2 * area[f])
            share = np.stack([1 - b1 - b2, b1, b2], axis=1)
            off = np.abs(height - 3e-4) + 10 * np.maximum(-share.min(axis=1), 0)
            better = off < best
            quarter = np.where(share.max(axis=1) > 0.5, share.argmax(axis=1), 3)
            best, where, part = np.where(better, off, best), np.where(better, f, where), np.where(better, quarter, part)
        assert best.max() < 5e-3, "a photon starts off the surface"
        expected = area[:, None] / 4 * np.einsum("qij,fj->fqi", corner, hat[faces]).mean(axis=2)
        counts = np.bincount(where * 4 + part, minlength=4 * len(faces)).reshape(-1, 4)
        assert_chi_squared(counts, expected / expected.sum() * n, f"places, hat {tag}")
        cosine = -(direction * normal[where]).sum(axis=1)
        assert cosine.min() >= -1e-6, "a photon leaves its own face"
        side = np.cross(normal[where], [0.3, 0.5, 0.8])
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        up = np.cross(normal[where], side)
        turn = np.arctan2((direction * up).sum(axis=1), (direction * side).sum(axis=1)) / (2 * math.pi) % 1.0
        assert_uniform(np.column_stack([np.minimum(cosine**2, 1), turn]), f"directions, hat {tag}")


def sphere_cells(direction: F64, rings: int = 12, turns: int = 12) -> tuple[NDArray[np.int64], F64, F64]:
    """Cell of each direction on an even grid of (z, azimuth), and quadrature nodes (K, M, 3) with weights (K, M)."""
    z, turn = np.clip(direction[:, 2], -1, 1), np.arctan2(direction[:, 1], direction[:, 0]) / (2 * math.pi) % 1.0
    ring = np.minimum((z + 1) / 2 * rings, rings - 1).astype(int)
    cell = ring * turns + np.minimum(turn * turns, turns - 1).astype(int)
    x, w = np.polynomial.legendre.leggauss(24)
    x, w = (x + 1) / 2, w / 2
    nodes, weights = [], []
    for i in range(rings):
        for j in range(turns):
            zz, tt = np.meshgrid(2 * (i + x) / rings - 1, 2 * math.pi * (j + x) / turns, indexing="ij")
            r = np.sqrt(1 - zz**2)
            nodes.append(np.stack([r * np.cos(tt), r * np.sin(tt), zz], axis=-1).reshape(-1, 3))
            weights.append((np.outer(w, w) * 4 * math.pi / (rings * turns)).ravel())
    return cell, np.array(nodes), np.array(weights)


def assert_aimed_at_sphere(position: F64, direction: F64) -> None:
    """Whatever the direction, places are uniform over the bounding disc across it, and start outside of the sphere."""
    along = (position * direction).sum(axis=1)
    offset = position - direction * along[:, None]
    side = np.cross(direction, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(direction, side)
    x, y = (offset * side).sum(axis=1) / RADIUS, (offset * up).sum(axis=1) / RADIUS
    assert along.max() < -RADIUS
    assert_uniform(np.column_stack([np.minimum(x**2 + y**2, 1), np.arctan2(y, x) / (2 * math.pi) % 1.0]), "disc")


def test_environment_is_density_times_radiance() -> None:
    """Power by direction = pi r^2 * integral of radiance, for a constant with two lobes, per wavelength."""
    lobes = (
        Lobe(direction=(0.3, 1.0, 0.4), sharpness=20.0, radiance=(6.0, 5.0, 0.0)),
        Lobe(direction=(-2.0, 0.2, 0.1), sharpness=4.0, radiance=(0.6, 0.9, 1.4)),
    )
    light = Environment(constant=(0.15, 0.2, 0.3), lobes=lobes)
    for lasers in ((0, 1, 2), (2,)):
        position, direction, weight = launch(light_source(light, RADIUS, lasers))
        assert_aimed_at_sphere(position, direction)
        cell, nodes, quadrature = sphere_cells(-direction)
        for k, laser in enumerate(lasers):
            radiance = np.full(nodes.shape[:2], light.constant[laser])
            for lobe in lobes:
                axis = np.array(lobe.direction) / np.linalg.norm(lobe.direction)
                radiance += lobe.radiance[laser] * np.exp(lobe.sharpness * (nodes @ axis - 1))
            expected = math.pi * RADIUS**2 * (radiance * quadrature).sum(axis=1)
            assert_power(weight[:, k], cell, expected, f"laser {laser} of {lasers}")


def test_uniform_light_is_even_and_exact() -> None:
    """Radiance 2 from everywhere: every photon carries 4 pi * pi r^2 * 2 times its colour."""
    light = Uniform(radiance=2.0, colour=(1.0, 0.5, 0.25))
    position, direction, weight = launch(light_source(light, RADIUS, (0, 1, 2)))
    assert_aimed_at_sphere(position, direction)
    exact = 8 * math.pi**2 * RADIUS**2 * np.array(light.colour)
    assert np.abs(weight / exact - 1).max() < 1e-5
    cell, _, quadrature = sphere_cells(direction)
    assert_chi_squared(np.bincount(cell, minlength=144), quadrature.sum(axis=1) * N / (4 * math.pi), "directions")


def test_directional_light_has_its_irradiance_and_its_edge() -> None:
    """Power = irradiance * pi r^2; with an edge, no photon on the dark side, all others untouched."""
    light = Directional(direction=(1.0, 2.0, -0.5), irradiance=0.3, colour=(1.0, 0.5, 2.0))
    position, direction, weight = launch(light_source(light, RADIUS, (0, 1, 2)))
    axis = np.array(light.direction) / np.linalg.norm(light.direction)
    assert np.abs(direction - axis).max() < 1e-6
    assert_aimed_at_sphere(position, direction)
    full = 0.3 * math.pi * RADIUS**2 * np.array(light.colour)
    assert np.abs(weight / full - 1).max() < 1e-6
    edged = light.model_copy(update={"edge_side": (0.1, 0.2, 1.0), "edge_offset_mm": 4.0})
    position, _, weight = launch(light_source(edged, RADIUS, (0, 1, 2)))
    side = np.array(edged.edge_side) - axis * (np.array(edged.edge_side) @ axis)
    beyond = position @ side / np.linalg.norm(side) - 4.0
    lit = weight[:, 0] > 0
    assert not np.any(lit & (beyond < -1e-4))
    assert not np.any(~lit & (beyond > 1e-4))
    assert np.abs(weight[lit] / full - 1).max() < 1e-6


def test_beam_light_has_its_power_and_diameter() -> None:
    light = Beam(name="spot", direction=(1.0, -1.0, 0.3), through_mm=(3.0, 4.0, 5.0), diameter_mm=5.0, power_w=0.01)
    position, direction, weight = launch(light_source(light, RADIUS, (0, 1, 2)))
    axis = np.array(light.direction) / np.linalg.norm(light.direction)
    offset = position - light.through_mm
    offset -= (offset @ axis)[:, None] * axis
    r2 = (offset**2).sum(axis=1) / 2.5**2
    assert np.abs(direction - axis).max() < 1e-6
    assert np.abs(weight / 0.01 - 1).max() < 1e-6
    assert np.linalg.norm(position, axis=1).min() > RADIUS
    assert_uniform(np.minimum(r2, 1.0), "radius", bins=500)


def test_projector_is_its_slide_times_cosines() -> None:
    """Power through a square of the plane at the aim = integral of intensity cos^3 * slide * cos^3 / D^2 da db."""
    light = TexturedProjector(
        position_mm=(300.0, -100.0, 120.0), aim_mm=(5.0, 2.0, -3.0), period_mm=8.0, contrast=0.7,
        half_width_mm=20.0, intensity=3.0, colour=(1.0, 0.5, 0.25),
    )  # fmt: skip
    position, direction, weight = launch(light_source(light, RADIUS, (0, 1, 2)))
    assert np.abs(position - light.position_mm).max() < 1e-4
    forward = np.subtract(light.aim_mm, light.position_mm)
    distance = np.linalg.norm(forward)
    forward /= distance
    right = np.cross(forward, light.up)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    scale = distance / (direction @ forward)
    a, b = (direction @ right) * scale, (direction @ down) * scale
    assert max(np.abs(a).max(), np.abs(b).max()) < 20.001
    cells = 20
    index = np.minimum((a + 20) / 40 * cells, cells - 1e-3).astype(int) * cells
    index += np.minimum((b + 20) / 40 * cells, cells - 1e-3).astype(int)
    fine = (np.arange(cells * 16) + 0.5) / (cells * 16) * 40 - 20
    aa, bb = np.meshgrid(fine, fine, indexing="ij")
    slide = (1 + 0.7 * np.sin(2 * math.pi * aa / 8) * np.sin(2 * math.pi * bb / 8)) / 1.7
    cosine = distance / np.sqrt(distance**2 + aa**2 + bb**2)
    density = 3.0 * slide * cosine**6 / distance**2 * (40 / (cells * 16)) ** 2
    expected = density.reshape(cells, 16, cells, 16).sum(axis=(1, 3)).ravel()
    for k, colour in enumerate(light.colour):
        assert_power(weight[:, k], index, expected * colour, f"laser {k}")


def test_projector_reaches_all_of_the_object() -> None:
    """A wide slide is cut to what can hit the bounding sphere, and no narrower, wherever the projector is aimed."""
    for aim in ((0.0, 0.0, 0.0), (30.0, 10.0, 0.0), (-150.0, 40.0, 10.0)):
        light = TexturedProjector(position_mm=(200.0, 0.0, 0.0), aim_mm=aim, half_width_mm=1e4)
        _, direction, _ = launch(light_source(light, RADIUS, (0, 1, 2)))
        towards = -np.array(light.position_mm)
        distance = np.linalg.norm(towards)
        cone = math.asin(RADIUS / distance)
        angle, turn = azimuth(direction, towards / distance)
        rim = np.arccos(np.clip(angle, -1, 1)) / cone
        at_rim = (rim > 0.93) & (rim < 1.0)
        assert np.all(np.bincount((turn[at_rim] * 36).astype(int), minlength=36) > 0), f"aimed at {aim}"
