"""Features of a procedural medium: the share of each voxel that they cover, with an edge that is one voxel wide."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from disco_twin.object.mesh import depth
from disco_twin.scene.object_schema import Crack, Feature, HollowCore, Layers, Patch, Veins
from hw.base.arrays import F64, I64
from hw.base.errors import InputError
from pipeline.geometry.mesh import closest

MOST_VEINS = 1e6


def coverage(feature: Feature, points: F64, cell: float, mesh: trimesh.Trimesh) -> F64:
    """(N,) share 0 .. 1 of the voxel of edge `cell` around each of the (N, 3) points that the feature covers.

    Raises: InputError for veins without number.
    """
    if isinstance(feature, Veins):
        return _sheet(_foam(feature, points, mesh), feature.width_mm, cell)
    if isinstance(feature, Crack):
        return _crack(feature, points, cell)
    if isinstance(feature, Layers):
        return _layers(feature, points, cell)
    if isinstance(feature, HollowCore):
        return _soft(feature.radius_mm - np.linalg.norm(points - feature.centre_mm, axis=1), cell)
    return _patch(feature, points, cell, mesh)


def _soft(inside: F64, cell: float) -> F64:
    """Share covered where the feature's edge lies `inside` mm away (negative: outside)."""
    return np.clip(inside / cell + 0.5, 0, 1)


def _sheet(distance: F64, width: float, cell: float) -> F64:
    """Share covered by a sheet of `width` whose mid-surface is `distance` >= 0 away: overlap of two intervals.

    A sheet thinner than a voxel keeps its optical thickness: the shares across it sum to width / cell.
    """
    overlap = np.minimum(distance + cell / 2, width / 2) - np.maximum(distance - cell / 2, -width / 2)
    return np.clip(overlap / cell, 0, 1)


def _unit(vector: ArrayLike) -> F64:
    values = np.asarray(vector, dtype=np.float64)
    return np.asarray(values / np.linalg.norm(values))


def _foam(feature: Veins, points: F64, mesh: trimesh.Trimesh) -> F64:
    """(N,) distance to the walls between warped Voronoi cells of about `spacing_mm`^3 each."""
    random = np.random.default_rng(feature.seed)
    low, high = mesh.bounds[0] - feature.spacing_mm, mesh.bounds[1] + feature.spacing_mm
    count = np.ceil(np.prod((high - low) / feature.spacing_mm))
    if count > MOST_VEINS:
        problem = f"there would be {count:.3g} cells between the veins"
        key, most = "object.medium.features.spacing_mm", f"at most {MOST_VEINS:.0e} cells"
        raise InputError(problem, key=key, value=feature.spacing_mm, allowed=most, remedy="a larger spacing_mm")
    sites = random.uniform(low, high, size=(int(count), 3))
    warped = points + 0.2 * feature.spacing_mm * _waves(points, feature.spacing_mm, random)
    index: I64 = np.asarray(cKDTree(sites).query(warped, k=2)[1])
    nearest, other = sites[index[:, 0]], sites[index[:, 1]]
    across = other - nearest
    distance = np.sum(((nearest + other) / 2 - warped) * across, axis=1) / np.linalg.norm(across, axis=1)
    return np.asarray(np.abs(distance))


def _waves(points: F64, length: float, random: np.random.Generator) -> F64:
    """(N, 3) smooth displacements of about unit size: four plane waves no shorter than `length`."""
    out = np.zeros_like(points)
    for _ in range(4):
        wave = _unit(random.normal(size=3)) * 2 * np.pi / length * random.uniform(0.3, 0.8)
        out += 0.5 * np.sin(points @ wave + random.uniform(0, 2 * np.pi))[:, None] * random.normal(size=3)
    return out


def _crack(feature: Crack, points: F64, cell: float) -> F64:
    normal = _unit(feature.normal)
    offset = points - feature.through_mm
    height = offset @ normal
    across = offset - height[:, None] * normal
    wave = np.sin(across @ np.array([0.7, 1.1, 0.9]) * 2 * np.pi / feature.radius_mm)
    sheet = _sheet(np.abs(height - feature.waviness_mm * wave), feature.width_mm, cell)
    return np.asarray(sheet * _soft(feature.radius_mm - np.linalg.norm(across, axis=1), cell))


def _layers(feature: Layers, points: F64, cell: float) -> F64:
    period, width = feature.period_mm, feature.share * feature.period_mm
    from_middle = points @ _unit(feature.direction) - feature.offset_mm - width / 2
    from_middle -= period * np.round(from_middle / period)  # to the nearest layer
    return _sheet(np.abs(from_middle), width, cell)


def _patch(feature: Patch, points: F64, cell: float, mesh: trimesh.Trimesh) -> F64:
    centre = closest(mesh, np.array([feature.centre_mm]))[0][0]
    ball = _soft(feature.radius_mm - np.linalg.norm(points - centre, axis=1), cell)
    near = ball > 0
    out = np.zeros(len(points))
    # Voxels outside the object count as painted: interpolation at the surface must not mix in bare material.
    out[near] = ball[near] * _soft(feature.depth_mm - depth(mesh, points[near]), cell)
    return out
