"""Conservative distance field: a lower bound of the distance to the surface, on a regular grid.

A distance is 1-Lipschitz, so it is known to within the way to the nearest cell's centre, and a flight of length l
from p to q cannot cross the surface if l < d(p) + d(q): the two empty balls overlap. Neither ball holds surface, so no
inside test is needed, and open, thin, nested and concave shapes are handled alike. The bound holds for the mesh itself,
not for samples of it (see `build_distance_field`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy import ndimage

from disco_twin.object.mesh import distance_to
from hw.base.arrays import F32, F64, I64

NEAR = 8.0  # cells from the surface within which distances are exact


@dataclass(frozen=True)
class DistanceField:
    """distance: (n, n, n) float32 in mm, index [z, y, x], a lower bound at the cell's centre, 0 at the grid's rim;
    normal: (n, n, n, 3) float32, outward unit normal of the nearest surface; low: (3,) corner; cell: edge in mm.
    """

    distance: F32
    normal: F32
    low: F64
    cell: float

    @property
    def cells(self) -> int:
        return len(self.distance)


def sample_surface(mesh: trimesh.Trimesh, spacing: float) -> tuple[F64, I64]:
    """Points that leave no surface point farther than `spacing` from one of them: (n, 3) and their faces (n,).

    Every triangle gets a barycentric lattice of k steps, its longest edge / k <= spacing: any point of the triangle
    lies in a lattice triangle similar to it, hence within that small triangle's longest edge of a corner.
    """
    triangles = np.asarray(mesh.triangles, float)
    longest = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(1, np.ceil(longest / spacing)).astype(int)
    points, faces = [], []
    for k in np.unique(steps):
        index = np.flatnonzero(steps == k)
        i, j = np.meshgrid(np.arange(k + 1), np.arange(k + 1), indexing="ij")
        keep = i + j <= k
        b1, b2 = i[keep] / k, j[keep] / k
        # Chunked, since one large triangle on a fine grid makes many points.
        for part in np.array_split(index, max(1, len(index) * len(b1) // 2_000_000)):
            a = triangles[part]
            grid = a[:, None, 0] + (a[:, 1] - a[:, 0])[:, None] * b1[None, :, None]
            grid = grid + (a[:, 2] - a[:, 0])[:, None] * b2[None, :, None]
            points.append(grid.reshape(-1, 3))
            faces.append(np.repeat(part, len(b1)))
    return np.concatenate(points), np.concatenate(faces)


def build_distance_field(mesh: trimesh.Trimesh, cells: int = 128) -> DistanceField:
    """Lower bound of the distance to `mesh` on a cube of `cells`^3 cells around it.

    Exact in the cells near the surface. Deeper ones take the Euclidean distance transform between cell centres, less
    what it can overstate: half a diagonal for the sample's place in its cell, and the spacing of the samples.
    """
    low, high = np.asarray(mesh.bounds, float)
    extent = float((high - low).max())
    cell = extent / (cells - 8)
    corner = (low + high) / 2 - cell * cells / 2
    spacing = cell / 2
    points, faces = sample_surface(mesh, spacing)
    index = np.floor((points - corner) / cell).astype(np.int64)
    flat = (index[:, 2] * cells + index[:, 1]) * cells + index[:, 0]
    touched = np.zeros(cells**3, bool)
    touched[flat] = True
    place = np.cumsum(touched, dtype=np.int32) - 1  # of a touched cell among them
    faced = np.asarray(mesh.face_normals)[faces]
    summed = np.stack([np.bincount(place[flat], faced[:, axis]) for axis in range(3)], axis=1)
    empty = ~touched.reshape((cells,) * 3)
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    steps = np.sqrt(sum((n - k) ** 2 for n, k in zip(nearest, np.ogrid[:cells, :cells, :cells], strict=True)))
    distance = np.maximum(steps * cell - cell * math.sqrt(3.0) / 2 - spacing, 0.0)
    surface = place[(nearest[0] * cells + nearest[1]) * cells + nearest[2]]
    near = np.argwhere(steps <= NEAR)
    # Light flies inside: cells that are surely outside keep their bound.
    away = (near - nearest[:, near[:, 0], near[:, 1], near[:, 2]].T)[:, ::-1]
    facing = np.einsum("nk,nk->n", away, summed[surface[tuple(near.T)]])
    near = near[(facing <= 0) | (steps[tuple(near.T)] < 2)]
    exact = distance_to(mesh, corner + (near[:, ::-1] + 0.5) * cell)
    distance[tuple(near.T)] = exact
    # Single precision, here and where the walk looks up its cell.
    distance = np.maximum(distance - 1e-5 * extent - 4e-7 * float(np.abs(mesh.bounds).max()), 0.0)
    for axis in range(3):
        for rim in (0, -1):
            np.moveaxis(distance, axis, 0)[rim] = 0.0  # a look-up outside the grid is clamped to its rim
    parts = [ndimage.gaussian_filter(summed[:, axis][surface], 1.5, truncate=2.0) for axis in range(3)]
    length = np.maximum(np.sqrt(parts[0] ** 2 + parts[1] ** 2 + parts[2] ** 2), 1e-12)
    normal = np.stack([(part / length).astype(np.float32) for part in parts], axis=-1)
    return DistanceField(distance.astype(np.float32), normal, corner, cell)
