"""What the reconstruction asks of the scanned mesh: hat areas, normals, rays, Laplacian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


CREASE = np.cos(np.deg2rad(30.0))  # between a vertex's normal and a triangle's


@dataclass(frozen=True)
class Hits:
    """First hits of N rays. triangle: (N,), -1 where nothing is hit; barycentric: (N, 3); distance: (N,) mm."""

    triangle: I64
    barycentric: F64
    distance: F64


@dataclass(frozen=True)
class Facets:
    """What every ray asks of a mesh's F triangles, worked out once.

    corner: (F, 3) their first; normal: (F, 3), as long as twice the area; towards_b, towards_c: (F, 3) gradients of the
    barycentric weights of b and c; smooth: (F, 3, 3) unit normals at the corners, the triangle's own at a crease.
    """

    mesh: trimesh.Trimesh
    corner: F64
    normal: F64
    towards_b: F64
    towards_c: F64
    smooth: F64

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> Facets:
        """Of all triangles of a mesh."""
        a, b, c = np.moveaxis(np.asarray(mesh.triangles, np.float64), 1, 0)
        normal = np.cross(b - a, c - a)
        square = np.maximum((normal**2).sum(axis=1), 1e-300)[:, None]
        smooth = np.asarray(mesh.vertex_normals, np.float64)[mesh.faces]
        flat = np.asarray(mesh.face_normals, np.float64)[:, None]
        corners = np.where((smooth * flat).sum(axis=2, keepdims=True) < CREASE, flat, smooth)
        return cls(mesh, a, normal, np.cross(c - a, normal) / square, np.cross(normal, b - a) / square, corners)

    def first_hit(self, origins: F64, directions: F64) -> Hits:
        """First triangle that each ray meets; (N, 3) origins in mm, (N, 3) unit directions.

        Embree finds the triangle; where the ray meets its plane is worked out in double precision.
        """
        triangle = np.asarray(self.mesh.ray.intersects_first(origins, directions), np.int64)
        barycentric, distance = np.zeros((len(triangle), 3)), np.full(len(triangle), np.inf)
        hit = np.flatnonzero(triangle >= 0)
        own, d = triangle[hit], directions[hit]
        to_corner, across = self.corner[own] - origins[hit], self.normal[own]
        slope = _dot(across, d)
        distance[hit] = _dot(across, to_corner) / np.where(np.abs(slope) > 1e-12, slope, 1e-12)
        place = d * distance[hit][:, None] - to_corner
        weights = np.empty((len(hit), 3))
        weights[:, 1], weights[:, 2] = _dot(self.towards_b[own], place), _dot(self.towards_c[own], place)
        weights[:, 0] = 1.0 - weights[:, 1] - weights[:, 2]
        np.clip(weights, 0.0, 1.0, out=weights)  # embree's edges are float32 wide
        barycentric[hit] = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
        return Hits(triangle, barycentric, distance)

    def normals(self, triangle: I64, barycentric: F64) -> F64:
        """(N, 3) unit normals: vertex normals interpolated over the triangles; the triangle's own at a crease.

        Interpolated normals stand for the smooth object better than flat faces do: on a sphere of 642 vertices the
        error of F_t over an image is 0.2 % instead of 0.8 %.
        """
        normals = np.einsum("nkd,nk->nd", self.smooth[triangle], barycentric)
        return np.asarray(normals / np.sqrt(_dot(normals, normals))[:, None])


def first_hit(mesh: trimesh.Trimesh, origins: F64, directions: F64) -> Hits:
    """`Facets.first_hit` of a mesh that is asked once."""
    return Facets.of(mesh).first_hit(origins, directions)


def interpolated_normals(mesh: trimesh.Trimesh, triangle: I64, barycentric: F64) -> F64:
    """`Facets.normals` of a mesh that is asked once."""
    return Facets.of(mesh).normals(triangle, barycentric)


def _dot(a: F64, b: F64) -> F64:
    """(N,) products of the rows of two (N, 3)."""
    return np.asarray(np.einsum("ni,ni->n", a, b))


def vertex_areas(mesh: trimesh.Trimesh) -> F64:
    """(V,) integral of each vertex's hat function in mm^2; they add up to the mesh's area."""
    share = np.repeat(np.asarray(mesh.area_faces, np.float64) / 3.0, 3)
    return np.bincount(mesh.faces.ravel(), share, minlength=len(mesh.vertices)).astype(np.float64)


def interpolation(mesh: trimesh.Trimesh, triangle: I64, barycentric: F64) -> sparse.csr_array:
    """(N, V) values at vertices -> values at N surface points."""
    n = len(triangle)
    rows = np.repeat(np.arange(n), 3)
    shape = (n, len(mesh.vertices))
    return sparse.csr_array((barycentric.ravel(), (rows, mesh.faces[triangle].ravel())), shape=shape)


def stiffness(mesh: trimesh.Trimesh) -> sparse.csr_array:
    """(V, V) cotangent stiffness matrix, positive semidefinite; times values it integrates grad . grad."""
    corner = np.asarray(mesh.triangles)
    rows, columns, values = [], [], []
    for k in range(3):
        a, b = corner[:, (k + 1) % 3] - corner[:, k], corner[:, (k + 2) % 3] - corner[:, k]
        twice_area = np.linalg.norm(np.cross(a, b), axis=1)
        half_cotangent = 0.5 * (a * b).sum(axis=1) / np.maximum(twice_area, 1e-12)
        i, j = mesh.faces[:, (k + 1) % 3], mesh.faces[:, (k + 2) % 3]
        rows += [i, j, i, j]
        columns += [j, i, i, j]
        values += [-half_cotangent, -half_cotangent, half_cotangent, half_cotangent]
    n = len(mesh.vertices)
    return sparse.coo_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n)
    ).tocsr()
