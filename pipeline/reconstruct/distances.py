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
from numpy.typing import NDArray
from scipy import sparse

from pipeline.reconstruct.mesh import interpolation, vertex_areas
from pipeline.reconstruct.spots import Spots

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Kernel = Callable[[F64], F64]

REACH = 4.0  # edges
BINS_PER_EDGE = 25


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
        far = np.log(kernel(self.distance))
        step = 0.02 * self.centres[-1]
        ahead = np.log(kernel(self.distance + step))
        behind = np.log(kernel(np.maximum(self.distance - step, 0.0)))
        slope, bend = (ahead - behind) / (2 * step), (ahead - 2 * far + behind) / step**2
        # Laplacian of the kernel over the kernel, in the plane, in terms of its logarithm.
        laplacian = bend + slope**2 + slope / np.maximum(self.distance, step)
        out = np.exp(far + 0.5 * self.spread * np.clip(laplacian, -1 / self.spread, 1 / self.spread))
        out[self.first, self.second] = self.histogram @ kernel(self.centres)
        return np.asarray(out)


def subtriangle_points(mesh: trimesh.Trimesh, n: int) -> tuple[F64, sparse.csr_array]:
    """Centroids (Q, 3) of n^2 equal parts per triangle and (V, Q) weights that average over each hat function."""
    corner = np.array([(i, j) for i in range(n) for j in range(n - i)], float)
    up = (corner + 1 / 3) / n
    down = (corner[corner.sum(axis=1) < n - 1] + 2 / 3) / n
    inner = np.concatenate([up, down])
    local = np.column_stack([1 - inner.sum(axis=1), inner])
    triangle = np.repeat(np.arange(len(mesh.faces)), len(local))
    barycentric = np.tile(local, (len(mesh.faces), 1))
    points = np.einsum("qk,qkx->qx", barycentric, np.asarray(mesh.triangles)[triangle])
    area = np.repeat(mesh.area_faces / len(local), len(local))
    hats = interpolation(mesh, triangle, barycentric).multiply(area[:, None]).T.tocsr()
    return points, sparse.csr_array(sparse.diags_array(1.0 / vertex_areas(mesh)) @ hats)


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


def _pairs(mesh: trimesh.Trimesh, centres: F64, patches: list[tuple[F64, F64]], spread: float) -> Pairs:
    """Patches are (points, weights); weights add up to 1."""
    edge = float(mesh.edges_unique_length.mean())
    width, reach = edge / BINS_PER_EDGE, REACH * edge
    bins = int(np.ceil((reach + 4 * mesh.edges_unique_length.max()) / width))
    points, weights = subtriangle_points(mesh, 4)
    to_vertex = weights.tocsc()
    distance = np.linalg.norm(centres[:, None] - np.asarray(mesh.vertices)[None], axis=2)
    first, second, blocks = [], [], []
    for i, (here, share) in enumerate(patches):
        near = np.flatnonzero(distance[i] < reach)
        local = np.full(len(mesh.vertices), -1)
        local[near] = np.arange(len(near))
        candidates = np.flatnonzero(((points - centres[i]) ** 2).sum(axis=1) < (reach + 1.5 * edge) ** 2)
        part = to_vertex[:, candidates].tocoo()
        keep = local[part.row] >= 0
        vertex, column, weight = local[part.row[keep]], part.col[keep], part.data[keep]
        between = np.linalg.norm(here[:, None] - points[candidates][None], axis=2)
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
    """Mean variance per axis of a hat function about its vertex, mm^2 (equilateral triangles: 5/36 edge^2)."""
    return float(5.0 / 36.0 * (mesh.edges_unique_length**2).mean())


def spot_pairs(mesh: trimesh.Trimesh, spots: Spots) -> Pairs:
    """Beams against hat functions: what is measured."""
    points = beam_points(spots)
    share = np.full(points.shape[1], 1.0 / points.shape[1])
    spread = spots.beam_radius**2 / 4 + _hat_spread(mesh)
    return _pairs(mesh, spots.position, [(p, share) for p in points], spread)


def vertex_pairs(mesh: trimesh.Trimesh) -> Pairs:
    """Hat functions against hat functions: what the model holds. The points differ, so that no distance is 0."""
    points, weights = subtriangle_points(mesh, 3)
    rows = [weights[[v]].tocoo() for v in range(len(mesh.vertices))]
    patches = [(points[row.col], row.data) for row in rows]
    return _pairs(mesh, np.asarray(mesh.vertices), patches, 2 * _hat_spread(mesh))
