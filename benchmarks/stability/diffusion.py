"""Light that diffuses: the medium inside a scan, and the estimate that guides photons, where free paths are far smaller
than cells, where there are voids, and where light ends.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import trimesh

from benchmarks.stability.case import Ends, Family, relative
from benchmarks.stability.completion import ball
from disco_twin.light import importance
from disco_twin.object.build import Medium, TwinBoundary, TwinObject
from hw.base.arrays import F64
from pipeline.geometry.fresnel import mean_transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.reconstruct.medium.diffusion import Diffusion
from pipeline.reconstruct.medium.medium_fit import fit_medium
from pipeline.reconstruct.medium.tetrahedra import fill

FAMILY = Family("diffusion")
RADIUS, ETA = 10.0, 1.3


def sphere(subdivisions: int = 2, radius: float = RADIUS) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)


@cache
def inside(radius: float = RADIUS) -> Diffusion:
    return Diffusion.of(sphere(radius=radius), ETA)


def leaving() -> float:
    """Flux out per fluence rate."""
    t = mean_transmittance(ETA) / ETA**2
    return t / (2 * (2 - t))


def evenly_lit(diffusivity: float, absorption: float, radius: float = RADIUS) -> float:
    """Relative error of the mean fluence on a ball that is lit evenly: q / (D (k coth k R - 1 / R) + leaving)."""
    found, area = inside(radius), RayMesh.of(sphere(radius=radius)).vertex_areas
    fluence = found.solver(diffusivity, absorption)(area[:, None])[: len(area), 0]
    k = np.sqrt(absorption / diffusivity)
    slope = k / np.tanh(k * radius) - 1 / radius if k * radius > 1e-4 else k**2 * radius / 3
    return relative((fluence @ area) / area.sum(), 1 / (diffusivity * slope + leaving()))


for d, a, tolerance in ((0.4, 0.004, 0.03), (1e-4, 0.0, 1e-8), (1e4, 0.0, 1e-6), (1e3, 1e-9, 1e-4)):
    FAMILY.case(
        f"a ball lit evenly, D {d:g} mm, sigma_a {a:g} / mm", "the closed solution", f"D / R {d / RADIUS:g}", tolerance
    )(partial(evenly_lit, d, a))
for radius in (0.5, 150.0):
    FAMILY.case(f"a ball of {2 * radius:g} mm lit evenly", "the closed solution", f"{2 * radius:g} mm", 0.03)(
        partial(evenly_lit, 0.04 * radius, 0.04 / radius, radius)
    )


@FAMILY.case(
    "cells of ten free paths",
    "the closed solution, or refused: too coarse for what light falls by",
    "an edge of 3 mm, light falls by exp(-10) over it",
    0.1,
    ends=Ends.EITHER,
    slow=True,
)
def coarse() -> float:
    own = ball(2, 80, 0.0).samples
    steep = (0.03 * np.exp(-10 * own.spot_pairs.distance / own.edge))[None].astype(np.float32)
    samples = replace(own, values=steep, noise_per_signal=(1e-4 * steep).astype(np.float32))
    medium = fit_medium(samples, 0, Diffusion.of(own.mesh, own.eta))
    return relative(np.sqrt(medium.absorption / medium.diffusivity) * own.edge, 10.0)


def two_shells() -> trimesh.Trimesh:
    """A ball with a hollow core: the core's triangles face inwards."""
    core = sphere(1, 5.0)
    core.invert()
    return trimesh.util.concatenate([sphere(), core])


@FAMILY.case(
    "a ball with a void", "the tetrahedra fill what lies between, and no more", "a core of half the radius", 0.02
)
def void() -> float:
    mesh = two_shells()
    return relative(fill(mesh).volumes.sum(), mesh.volume)


@FAMILY.case(
    "a sheet thinner than its triangles", "filled to a per cent, or refused", ".2 mm of 20", 0.01, ends=Ends.EITHER
)
def sheet() -> float:
    mesh = trimesh.creation.box((20.0, 20.0, 0.2)).subdivide().subdivide()
    return relative(fill(mesh).volumes.sum(), mesh.volume)


@FAMILY.case("points in one plane", "refused: they span no tetrahedra", "thickness 0", ends=Ends.REFUSED)
def flat() -> float:
    mesh = trimesh.creation.box((20.0, 20.0, 1.0))
    mesh.vertices[:, 2] = 0.0
    return float(fill(mesh).volumes.sum())


# ---------------------------------------------------------------- the estimate that guides photons
def grid_object(sigma_t: F64, albedo: float, side: float = 20.0, eta: float = 1.0) -> TwinObject:
    """A cube whose medium is a grid (nz, ny, nx) of sigma_t in 1/mm."""
    mesh = trimesh.creation.box((side, side, side))
    s = sigma_t[None].astype(np.float32)
    medium = Medium(s, np.full_like(s, albedo), np.full(3, -side / 2), np.full(3, side / 2), (0.0,))
    return TwinObject(mesh, TwinBoundary("rough" if eta > 1 else "matched", eta, 0.3), medium)


def unbalanced(grid: F64, albedo: float) -> float:
    """Share of a watt that is neither absorbed nor leaves, by the estimate; not finite where fluence is."""
    found = importance.diffusion(grid_object(grid, albedo), 0, 16)
    fluence = found.fluence(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 9.9]]))[:, found.filled]
    if not (np.isfinite(fluence).all() and (fluence > 0).all()):
        return np.nan
    absorbed = fluence @ found.absorption * found.cell**3
    d, n = 1 / (3 * np.maximum(found.absorption + found.reduced, 1e-3 / found.cell)), found.number
    out, filled = np.zeros(len(d)), found.filled
    for axis in range(3):
        for step in (-1, 1):
            rim = filled & ~np.roll(filled, -step, axis=axis)
            cells = n[rim]
            out[cells] += found.cell**2 / (found.cell / (2 * d[cells]) + 1 / found.leak)
    return float(np.abs(absorbed + fluence @ out - 1).max())


def windows_off(grid: F64, albedo: float) -> float:
    """How many target weights are out of range."""
    found = importance.diffusion(grid_object(grid, albedo), 0, 16)
    targets = importance.window_targets(found.fluence(np.array([[0.0, 0.0, 9.9]])), found.filled, 3.0)
    return float((~(np.isfinite(targets) & (targets > 0) & (targets <= 1))).sum())


def layered(low: float, high: float) -> F64:
    grid = np.full((16, 16, 16), low)
    grid[4:8, 4:12, 4:12] = high
    return grid


for name, grid, albedo, extent in (
    ("cells of ten free paths", np.full((1, 1, 1), 8.0), 0.9, "10 free paths a cell"),
    ("10,000 free paths a mm", np.full((1, 1, 1), 1e4), 0.999, "12,500 free paths a cell"),
    ("a void", layered(2.0, 0.0), 0.99, "sigma_t 0 within"),
    ("a black inclusion", layered(2.0, 1e4), 0.5, "5000 times as dense, black"),
    ("contrast of 1e6", layered(1e-2, 1e4), 0.999, "1e-2 .. 1e4 / mm"),
    ("nothing absorbs", np.full((1, 1, 1), 2.0), 1.0, "albedo 1"),
    ("all is absorbed", np.full((1, 1, 1), 2.0), 0.0, "albedo 0"),
):
    FAMILY.case(
        f"guiding photons: {name}", "what is absorbed and what leaves add up; fluence is positive", extent, 1e-8
    )(partial(unbalanced, grid, albedo))
    FAMILY.case(
        f"windows: {name}",
        "target weights between the darkest and 1, none a power that is not finite",
        extent,
        slow=True,
    )(partial(windows_off, grid, albedo))


@FAMILY.case("guiding photons through a plate thinner than a cell", "fluence is finite and positive", ".01 mm of 20")
def plate() -> float:
    mesh = trimesh.creation.box((20.0, 20.0, 0.01))
    s = np.full((1, 1, 1, 1), 5.0, np.float32)
    low, high = np.asarray(mesh.bounds, np.float64)
    obj = TwinObject(mesh, TwinBoundary("matched", 1.0, 0.3), Medium(s, np.full_like(s, 0.9), low, high, (0.0,)))
    found = importance.diffusion(obj, 0, 16)
    fluence = found.fluence(np.array([[0.0, 0.0, 0.0]]))
    return float((~(np.isfinite(fluence) & (fluence > 0))).sum())
