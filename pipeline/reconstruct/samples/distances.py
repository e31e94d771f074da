"""Distances between patches: what averaging over a hat function and over the beam does to a steep kernel.

R_d falls by decades within an edge's length, so the mean over a hat function is not the value at its vertex. A kernel
that depends on distance alone is averaged exactly by a histogram of the distances between two patches, which is
computed once and serves every kernel: mean = histogram @ kernel(bin centres). Pairs further apart than `REACH` edges
use the second moments of the patches instead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy import sparse
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from hw.base.arrays import F64, I64
from pipeline.geometry.mesh import RayMesh
from pipeline.reconstruct.samples.spots import Spots

Kernel = Callable[[F64], F64]

REACH = 4.0  # edges
BINS_PER_EDGE = 25
TABLE = 4096


@dataclass(frozen=True)
class Pairs:
    """Patches of one kind (N of them) against the hat functions of all vertices (V).

    distance: (N, V) mm between centres; first, second: (P,) indices of the near pairs;
    histogram: (P, bins) shares of distance; centres: (bins,) mm; spread: mm^2, sum of both patches' variances per axis
    """

    distance: F64
    first: I64
    second: I64
    histogram: sparse.csr_array
    centres: F64
    spread: float

    def mean(self, kernel: Kernel) -> F64:
        """(N, V) mean of kernel(distance) over both patches; the kernel is positive."""
        # Far pairs: the kernel is locally exponential; its Laplacian in the plane over itself is slope^2 + slope / r.
        # It is a function of distance alone, so a fine table of its logarithm serves all pairs.
        table = np.linspace(0.0, float(self.distance.max()), TABLE)
        step = 0.04 * self.centres[-1]
        slope = np.log(kernel(table + step) / kernel(np.maximum(table - step, 0.0))) / (2 * step)
        laplacian = np.minimum(slope**2 + slope / np.maximum(table, step), 1 / self.spread)
        logarithm = np.log(kernel(table)) + 0.5 * self.spread * laplacian
        at = self.distance * ((TABLE - 1) / table[-1])
        low = np.minimum(at.astype(np.int32), TABLE - 2)
        out = np.exp(logarithm[low] + (at - low) * np.diff(logarithm)[low])
        out[self.first, self.second] = self.histogram @ kernel(self.centres)
        return np.asarray(out)


@dataclass(frozen=True)
class HatPoints:
    """Points on the surface, each a part of the three hat functions of its triangle.

    points: (Q, 3) mm; vertices: (Q, 3); weights: (Q, 3) share of each hat's integral, adding up to 1 per vertex
    """

    points: F64
    vertices: I64
    weights: F64


def hat_points(mesh: trimesh.Trimesh, n: int) -> HatPoints:
    """Centroids of n^2 equal parts per triangle."""
    corner = np.array([(i, j) for i in range(n) for j in range(n - i)], float)
    up = (corner + 1 / 3) / n
    down = (corner[corner.sum(axis=1) < n - 1] + 2 / 3) / n
    inner = np.concatenate([up, down])
    local = np.column_stack([1 - inner.sum(axis=1), inner])
    points = np.einsum("qk,fkx->fqx", local, np.asarray(mesh.triangles)).reshape(-1, 3)
    vertices = np.repeat(np.asarray(mesh.faces, np.int64), len(local), axis=0)
    area = np.repeat(np.asarray(mesh.area_faces, np.float64) / len(local), len(local))
    weights = np.tile(local, (len(mesh.faces), 1)) * area[:, None] / RayMesh.of(mesh).vertex_areas[vertices]
    return HatPoints(points, vertices, weights)


def beam_points(spots: Spots) -> F64:
    """(S, 19, 3) points of equal weight in each beam's footprint on the plane that touches the scan at the spot."""
    rings = [(0.0, 1, 0.0), (0.46, 6, 0.0), (0.84, 12, 0.5)]  # radius in beam radii, points, turn: equal areas
    polar = [(r, 2 * np.pi * (k + turn) / m) for r, m, turn in rings for k in range(m)]
    radius, angle = np.array(polar).T * np.array([[spots.beam_radius], [1.0]])
    d, n = spots.direction, spots.normal
    helper = np.where(np.abs(d[:, :1]) > 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    a = np.cross(d, helper)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(d, a)
    across = a[:, None] * (radius * np.cos(angle))[:, None] + b[:, None] * (radius * np.sin(angle))[:, None]
    slide = (across * n[:, None]).sum(axis=2) / np.minimum((d * n).sum(axis=1), -0.1)[:, None]
    return np.asarray(spots.position[:, None] + across - d[:, None] * slide[:, :, None])


def beam_footprints(mesh: trimesh.Trimesh, spots: Spots) -> sparse.csr_array:
    """(S, V) mean of each vertex's hat function over a beam's footprint; rows add up to 1.

    Rays that miss the scan at its outline count for the axis.
    """
    points = beam_points(spots)
    count = points.shape[1]
    direction = np.repeat(spots.direction, count, axis=0)
    back = 4.0 * float(np.linalg.norm(mesh.extents))
    hit = RayMesh.of(mesh).first_hit(points.reshape(-1, 3) - back * direction, direction)
    missed = np.flatnonzero(hit.triangle < 0) // count
    hit.triangle[hit.triangle < 0] = spots.triangle[missed]
    hit.barycentric[hit.barycentric.sum(axis=1) == 0] = spots.barycentric[missed]
    spot = np.repeat(np.arange(len(points)), count)
    mean = sparse.csr_array((np.full(len(spot), 1.0 / count), (spot, np.arange(len(spot)))))
    return sparse.csr_array(mean @ RayMesh.of(mesh).interpolation(hit.triangle, hit.barycentric))


def _pairs(mesh: trimesh.Trimesh, centres: F64, patches: list[tuple[F64, F64]], spread: float) -> Pairs:
    """Patches are (points, weights); weights add up to 1."""
    edge, longest = float(mesh.edges_unique_length.mean()), float(mesh.edges_unique_length.max())
    width, reach = edge / BINS_PER_EDGE, REACH * edge
    bins = int(np.ceil((reach + 4 * mesh.edges_unique_length.max()) / width))
    parts = hat_points(mesh, 4)
    tree = cKDTree(parts.points)
    distance = np.linalg.norm(centres[:, None] - np.asarray(mesh.vertices)[None], axis=2)
    first, second, blocks = [], [], []
    for i, (here, share) in enumerate(patches):
        near = np.flatnonzero(distance[i] < reach)
        local = np.full(len(mesh.vertices), -1)
        local[near] = np.arange(len(near))
        candidates = np.array(tree.query_ball_point(centres[i], reach + 1.05 * longest))
        vertex = local[parts.vertices[candidates]]
        column, corner = np.nonzero(vertex >= 0)
        vertex, weight = vertex[column, corner], parts.weights[candidates][column, corner]
        between = cdist(here, parts.points[candidates])
        slot = np.minimum((between / width).astype(np.int64), bins - 1)[:, column] + vertex * bins
        amount = share[:, None] * weight
        table = np.bincount(slot.ravel(), amount.ravel(), minlength=len(near) * bins)
        rows = table.reshape(len(near), bins)
        blocks.append(sparse.csr_array(rows / rows.sum(axis=1, keepdims=True)))
        first.append(np.full(len(near), i))
        second.append(near)
    histogram = sparse.csr_array(sparse.vstack(blocks))
    middle: F64 = (np.arange(bins, dtype=np.float64) + 0.5) * width
    return Pairs(distance, np.concatenate(first), np.concatenate(second), histogram, middle, spread)


def _hat_spread(mesh: trimesh.Trimesh) -> float:
    """Mean variance per axis of a hat function about its vertex, mm^2 (equilateral triangles: edge^2 / 8)."""
    return float((mesh.edges_unique_length**2).mean() / 8.0)


def spot_pairs(mesh: trimesh.Trimesh, spots: Spots) -> Pairs:
    """Beams against hat functions: what is measured."""
    points = beam_points(spots)
    share = np.full(points.shape[1], 1.0 / points.shape[1])
    spread = spots.beam_radius**2 / 4 + _hat_spread(mesh)
    return _pairs(mesh, spots.position, [(p, share) for p in points], spread)


def vertex_pairs(mesh: trimesh.Trimesh) -> Pairs:
    """Hat functions against hat functions: what the model holds. The points differ, so that no distance is 0."""
    parts = hat_points(mesh, 3)
    vertex, weight = parts.vertices.ravel(), parts.weights.ravel()
    order = np.argsort(vertex, kind="stable")
    point = np.repeat(np.arange(len(parts.points)), 3)[order]
    ends = np.cumsum(np.bincount(vertex, minlength=len(mesh.vertices)))[:-1]
    patches = list(zip(np.split(parts.points[point], ends), np.split(weight[order], ends), strict=True))
    return _pairs(mesh, np.asarray(mesh.vertices), patches, 2 * _hat_spread(mesh))
