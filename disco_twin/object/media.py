"""Media: per-wavelength grids of sigma_t and albedo from a homogeneous base, a measured material or voxel files.

Features are laid over the base in order. A feature covers each cell to a share w in 0 .. 1 (a soft edge one cell wide)
and is mixed in linearly in sigma_s and sigma_a, so that a thin feature keeps its optical thickness.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from disco_twin.object.materials import MATERIALS
from disco_twin.object.mesh import closest, depth
from disco_twin.object.schema import (
    Crack,
    Feature,
    HollowCore,
    Homogeneous,
    Layers,
    Material,
    MediumConfig,
    Patch,
    Veins,
)
from hw.errors import InputError

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Medium:
    """Cell-centred grid, trilinear in sigma_t and in sigma_s = sigma_t * albedo between centres, clamped outside them.

    sigma_t: (L, nz, ny, nx) float32 in 1/mm, homogeneous (L, 1, 1, 1); albedo: the same shape, 0 .. 1
    low, high: (3,) x, y, z corners of the grid in mm, object frame; g: L asymmetries (Henyey-Greenstein)
    """

    sigma_t: NDArray[np.float32]
    albedo: NDArray[np.float32]
    low: F64
    high: F64
    g: tuple[float, ...]


def build_medium(config: MediumConfig, mesh: trimesh.Trimesh, lasers: int) -> Medium:
    """The medium that fills `mesh`."""
    g = tuple(float(x) for x in per_wavelength(config.g, lasers, "object.medium.g"))
    base = config.base
    low, high = mesh.bounds[0].astype(float), mesh.bounds[1].astype(float)
    if isinstance(base, Homogeneous):
        sigma_t = per_wavelength(base.sigma_t_per_mm, lasers, "object.medium.base.sigma_t_per_mm")
        albedo = per_wavelength(base.albedo, lasers, "object.medium.base.albedo")
    elif isinstance(base, Material):
        sigma_t, albedo = material(base.name, lasers)
    else:
        raise NotImplementedError("grid")
    shape = (1, 1, 1)
    if config.features:
        low, high = low - config.cell_mm, high + config.cell_mm
        cells = np.ceil((high - low) / config.cell_mm).astype(int)
        high = low + cells * config.cell_mm
        shape = (cells[2], cells[1], cells[0])
    sigma_s = np.ones((lasers, *shape)) * (sigma_t * albedo)[:, None, None, None]
    sigma_a = np.ones((lasers, *shape)) * (sigma_t * (1 - albedo))[:, None, None, None]
    if config.features:
        centres = cell_centres(low, high, shape)
        cell = float(((high - low) / np.array(shape)[::-1]).max())
        for i, feature in enumerate(config.features):
            key = f"object.medium.features[{i}]"
            weight = coverage(feature, centres, cell, mesh).reshape(shape)
            t, a = feature_optics(feature, lasers, key)
            sigma_s += weight * ((t * a)[:, None, None, None] - sigma_s)
            sigma_a += weight * ((t * (1 - a))[:, None, None, None] - sigma_a)
    total = sigma_s + sigma_a
    ratio = np.divide(sigma_s, total, out=np.zeros_like(total), where=total > 0)
    return Medium(total.astype(np.float32), ratio.astype(np.float32), low, high, g)


def per_wavelength(value: float | tuple[float, ...], lasers: int, key: str) -> F64:
    """(L,) values from one for all lasers or one a laser."""
    out = np.atleast_1d(np.asarray(value, float))
    if len(out) not in (1, lasers):
        raise InputError(f"{len(out)} values for {lasers} lasers", key=key, value=value, allowed=f"1 or {lasers} values")
    return np.array(np.broadcast_to(out, (lasers,)))


def material(name: str, lasers: int) -> tuple[F64, F64]:
    """(L,) sigma_t = sigma_s' + sigma_a in 1/mm and (L,) albedo of a measured material (similarity: g = 0)."""
    if lasers != 3:
        raise InputError("measured materials have three wavelengths", key="object.medium.base.name", value=name)
    scatter, absorb = (np.array(x) for x in MATERIALS[name])
    return scatter + absorb, scatter / (scatter + absorb)


def feature_optics(feature: Feature, lasers: int, key: str) -> tuple[F64, F64]:
    """(L,) sigma_t in 1/mm and (L,) albedo of a feature."""
    if isinstance(feature, HollowCore):
        return np.zeros(lasers), np.zeros(lasers)
    return (
        per_wavelength(feature.sigma_t_per_mm, lasers, f"{key}.sigma_t_per_mm"),
        per_wavelength(feature.albedo, lasers, f"{key}.albedo"),
    )


def cell_centres(low: F64, high: F64, shape: tuple[int, int, int]) -> F64:
    """(nz * ny * nx, 3) x, y, z of the cell centres, x fastest."""
    z, y, x = (lo + (np.arange(n) + 0.5) * (hi - lo) / n for lo, hi, n in zip(low[::-1], high[::-1], shape, strict=True))
    zz, yy, xx = np.meshgrid(z, y, x, indexing="ij")
    return np.column_stack([xx.ravel(), yy.ravel(), zz.ravel()])


# ---------------------------------------------------------------- features: share of each cell that they cover
def coverage(feature: Feature, points: F64, cell: float, mesh: trimesh.Trimesh) -> F64:
    """(N,) share 0 .. 1 of a cell of edge `cell` around each of the (N, 3) points that the feature covers."""
    if isinstance(feature, Veins):
        return _sheet(_foam(points, feature.spacing_mm, feature.seed), feature.width_mm, cell)
    if isinstance(feature, Crack):
        return _crack(feature, points, cell)
    if isinstance(feature, Layers):
        along = (points @ _unit(feature.direction) - feature.offset_mm) % feature.period_mm
        middle = feature.share * feature.period_mm / 2
        gap = np.abs((along - middle + feature.period_mm / 2) % feature.period_mm - feature.period_mm / 2)
        return _sheet(gap, feature.share * feature.period_mm, cell)
    if isinstance(feature, HollowCore):
        return _soft(feature.radius_mm - np.linalg.norm(points - feature.centre_mm, axis=1), cell)
    return _patch(feature, points, cell, mesh)


def _soft(depth: F64, cell: float) -> F64:
    """Share covered where the feature's edge lies `depth` away (positive: inside), ramp one cell wide."""
    return np.clip(depth / cell + 0.5, 0, 1)


def _sheet(distance: F64, width: float, cell: float) -> F64:
    """Share covered by a sheet of `width` whose mid-surface is `distance` >= 0 away: overlap of two intervals."""
    overlap = np.minimum(distance + cell / 2, width / 2) - np.maximum(distance - cell / 2, -width / 2)
    return np.clip(overlap / cell, 0, 1)


def _unit(v: tuple[float, float, float]) -> F64:
    return np.asarray(v, float) / np.linalg.norm(v)


def _foam(points: F64, spacing: float, seed: int) -> F64:
    """(N,) distance to the walls of a warped Voronoi foam with about one cell per spacing^3."""
    from scipy.spatial import cKDTree

    random = np.random.default_rng(seed)
    low, high = points.min(axis=0) - spacing, points.max(axis=0) + spacing
    count = max(2, int(np.ceil(np.prod((high - low) / spacing))))
    sites = random.uniform(low, high, size=(count, 3))
    warped = points + 0.2 * spacing * _waves(points, spacing, random)
    _, index = cKDTree(sites).query(warped, k=2)
    near, next_ = sites[index[:, 0]], sites[index[:, 1]]
    across = next_ - near
    return np.abs(np.sum(((near + next_) / 2 - warped) * across, axis=1)) / np.linalg.norm(across, axis=1)


def _waves(points: F64, length: float, random: np.random.Generator) -> F64:
    """(N, 3) smooth displacements of about unit size and wavelength `length` or more: a few random plane waves."""
    out = np.zeros_like(points)
    for _ in range(4):
        wave = random.normal(size=3)
        wave *= 2 * np.pi / length * random.uniform(0.3, 0.8) / np.linalg.norm(wave)
        out += 0.5 * np.sin(points @ wave + random.uniform(0, 2 * np.pi))[:, None] * random.normal(size=3)
    return out


def _crack(feature: Crack, points: F64, cell: float) -> F64:
    normal = _unit(feature.normal)
    offset = points - feature.through_mm
    height = offset @ normal
    inplane = offset - height[:, None] * normal
    period = 2 * np.pi / max(feature.radius_mm, 1e-9)
    height = height - feature.waviness_mm * np.sin(period * inplane @ np.array([0.7, 1.1, 0.9]))
    sheet = _sheet(np.abs(height), feature.width_mm, cell)
    return sheet * _soft(feature.radius_mm - np.linalg.norm(inplane, axis=1), cell)


def _patch(feature: Patch, points: F64, cell: float, mesh: trimesh.Trimesh) -> F64:
    centre = closest(mesh, np.array([feature.centre_mm]))[0][0]
    ball = _soft(feature.radius_mm - np.linalg.norm(points - centre, axis=1), cell)
    inside = ball > 0
    out = np.zeros(len(points))
    # Cells outside the object count as painted: interpolation at the surface must not mix in bare material.
    out[inside] = ball[inside] * _soft(feature.depth_mm - depth(mesh, points[inside]), cell)
    return out
