"""What the reconstruction asks of the scanned mesh: hat areas, normals, rays, Laplacian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse
from trimesh.ray.ray_pyembree import RayMeshIntersector

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True)
class Hits:
    """First hits of N rays. triangle: (N,), -1 where nothing is hit; barycentric: (N, 3); distance: (N,) mm."""

    triangle: I64
    barycentric: F64
    distance: F64


def first_hit(mesh: trimesh.Trimesh, origins: F64, directions: F64) -> Hits:
    """First triangle that each ray meets; (N, 3) origins in mm, (N, 3) unit directions."""
    n = len(origins)
    triangle, barycentric, distance = np.full(n, -1, np.int64), np.zeros((n, 3)), np.full(n, np.inf)
    if n:
        points, ray, face = RayMeshIntersector(mesh).intersects_location(origins, directions, multiple_hits=False)
        triangle[ray] = face
        if len(ray):
            weights = np.clip(trimesh.triangles.points_to_barycentric(mesh.triangles[face], points), 0.0, 1.0)
            barycentric[ray] = weights / weights.sum(axis=1, keepdims=True)
            distance[ray] = ((points - origins[ray]) * directions[ray]).sum(axis=1)
    return Hits(triangle, barycentric, distance)


def vertex_areas(mesh: trimesh.Trimesh) -> F64:
    """(V,) integral of each vertex's hat function in mm^2; they add up to the mesh's area."""
    share = np.repeat(np.asarray(mesh.area_faces, np.float64) / 3.0, 3)
    return np.bincount(mesh.faces.ravel(), share, minlength=len(mesh.vertices)).astype(np.float64)


def interpolated_normals(mesh: trimesh.Trimesh, triangle: I64, barycentric: F64) -> F64:
    """(N, 3) unit normals: vertex normals interpolated over the triangles."""
    normals = (mesh.vertex_normals[mesh.faces[triangle]] * barycentric[:, :, None]).sum(axis=1)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


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
