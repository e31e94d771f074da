"""Meshes: what is refused, the coarser scan that the pipeline is given, hat functions from one mesh to the other."""

from __future__ import annotations

import gpytoolbox
import numpy as np
import scipy.sparse
import trimesh
from numpy.typing import NDArray

F64 = NDArray[np.float64]


def closest(mesh: trimesh.Trimesh, points: F64) -> tuple[F64, NDArray[np.int64]]:
    """(N, 3) closest points on the surface to (N, 3) points, and (N,) the triangles that they lie on."""
    v, f = _arrays(mesh)
    _, triangle, weights = gpytoolbox.squared_distance(points, v, f, use_cpp=True)
    return np.einsum("nk,nkd->nd", weights, v[f[triangle]]), triangle.astype(np.int64)


def depth(mesh: trimesh.Trimesh, points: F64) -> F64:
    """(N,) distance to the surface of (N, 3) points, positive inside."""
    v, f = _arrays(mesh)
    return -np.asarray(gpytoolbox.signed_distance(points, v, f)[0], float)


def remesh(mesh: trimesh.Trimesh, vertices: int) -> trimesh.Trimesh:
    """About `vertices` vertices on the surface of `mesh`, triangles of nearly equal area (Botsch and Kobbelt 2004)."""
    edge = float(np.sqrt(mesh.area / (2 * vertices) * 4 / np.sqrt(3)))
    out = mesh
    for _ in range(6):
        v, f = gpytoolbox.remesh_botsch(*_arrays(mesh), 20, edge, True)
        out = trimesh.Trimesh(v, f, process=False)
        if abs(len(v) / vertices - 1) < 0.01:
            break
        edge *= float(np.sqrt(len(v) / vertices))
    return out


def hat_basis(fine: trimesh.Trimesh, scan: trimesh.Trimesh) -> scipy.sparse.csr_matrix:
    """(V_fine, V_scan) values of the scan's hat functions at the fine vertices' closest points on the scan.

    Rows are barycentric weights: not negative, sum 1. The identity where both meshes are the same.
    """
    if fine.vertices.shape == scan.vertices.shape and np.array_equal(fine.vertices, scan.vertices):
        return scipy.sparse.identity(len(fine.vertices), format="csr")
    _, triangle, weights = gpytoolbox.squared_distance(_arrays(fine)[0], *_arrays(scan), use_cpp=True)
    weights = np.clip(weights, 0, None)
    weights /= weights.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(weights)), 3)
    columns = np.asarray(scan.faces)[triangle].ravel()
    shape = (len(fine.vertices), len(scan.vertices))
    return scipy.sparse.coo_matrix((weights.ravel(), (rows, columns)), shape=shape).tocsr()


def _arrays(mesh: trimesh.Trimesh) -> tuple[F64, NDArray[np.int32]]:
    """Plain (V, 3) float64 and (F, 3) int32 arrays, as gpytoolbox's C++ asks for."""
    return np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int32)
