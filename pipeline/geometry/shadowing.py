"""A triangle mesh as light sees it: flat faces, hat functions, occlusion by its own geometry (embree).

The hat function of a vertex is 1 there, 0 at all others and linear on every face.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

if TYPE_CHECKING:
    import trimesh

F64 = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

_LIFT = 1e-5  # of the mesh's size: shadow rays start this far above the face, far beyond embree's float32


@dataclass(frozen=True)
class Surface:
    """corners: (F, 3, 3) mm; normals: (F, 3) unit, outward; areas: (F,) mm^2; faces: (F, 3) vertex numbers.

    free: (F,) faces whose plane has the whole mesh below it; nothing can shade them.
    """

    mesh: trimesh.Trimesh
    vertices: int
    faces: Int
    corners: F64
    normals: F64
    areas: F64
    free: Bool
    size: float

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> Surface:
        """Prepare a mesh (mm, outward orientation, vertices as they are numbered)."""
        faces = np.asarray(mesh.faces, np.int64)
        points = np.asarray(mesh.vertices, np.float64)
        corners = points[faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        twice = np.linalg.norm(cross, axis=1)
        normals = cross / np.maximum(twice, np.finfo(float).tiny)[:, None]
        size = float(np.linalg.norm(np.ptp(points, axis=0)))
        free = np.empty(len(faces), bool)
        for start in range(0, len(faces), 4096):  # 4096 faces at a time bound the memory of the product
            n, c = normals[start : start + 4096], corners[start : start + 4096, 0]
            free[start : start + 4096] = (n @ points.T).max(axis=1) - (n * c).sum(axis=1) <= 1e-9 * size
        return cls(mesh, len(points), faces, corners, normals, 0.5 * twice, free, size)

    def points(self, face: Int, bary: F64) -> F64:
        """(N,) faces, (N, 3) barycentric coordinates -> (N, 3) mm."""
        return np.asarray(np.einsum("nk,nkx->nx", bary, self.corners[face]))

    def blocked(self, face: Int, points: F64, towards: F64) -> Bool:
        """(N,): does the mesh stand between points on the given faces and a light in the unit directions `towards`?"""
        hidden = np.zeros(len(face), bool)
        ask = np.flatnonzero(~self.free[face])
        if len(ask):
            origins = points[ask] + _LIFT * self.size * self.normals[face[ask]]
            hidden[ask] = self.mesh.ray.intersects_any(origins, towards[ask])
        return hidden

    def mass_matrix(self) -> sparse.csc_matrix:
        """(V, V) integrals of the products of two hat functions in mm^2; its row sums are the vertex areas."""
        local = self.areas[:, None, None] / 12 * (np.ones((3, 3)) + np.eye(3))
        rows = np.repeat(self.faces, 3, axis=1).ravel()
        columns = np.tile(self.faces, (1, 3)).ravel()
        return sparse.csc_matrix((local.ravel(), (rows, columns)), shape=(self.vertices, self.vertices))
