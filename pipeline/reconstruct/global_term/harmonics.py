"""Smooth functions on the scan: eigenfunctions of its Laplacian, in which smoothing and kriging are diagonal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.linalg import eigh

from hw.base.arrays import F64
from pipeline.geometry.mesh import RayMesh


@dataclass(frozen=True)
class Harmonics:
    """functions: (V, n), orthonormal in the mean over the surface; eigenvalues: (n,) in mm^-2, ascending."""

    functions: F64
    eigenvalues: F64

    def roughness(self, range_mm: float) -> F64:
        """(n,) penalty (1 + range^2 eigenvalue)^2: a Matern field of smoothness 1 (Lindgren et al. 2011, eq. 2)."""
        return np.asarray((1.0 + range_mm**2 * self.eigenvalues) ** 2)

    def covariance(self, range_mm: float) -> F64:
        """(V, V) covariance of that field, scaled to a mean variance of 1."""
        spectrum = 1.0 / self.roughness(range_mm)
        return np.asarray((self.functions * (spectrum / spectrum.sum())) @ self.functions.T)


def harmonics(mesh: trimesh.Trimesh, most: int) -> Harmonics:
    """The smoothest `most` eigenfunctions (all of them on smaller meshes), with lumped masses."""
    surface = RayMesh.of(mesh)
    area = surface.vertex_areas
    scale = 1.0 / np.sqrt(area)
    matrix = scale[:, None] * surface.stiffness.toarray() * scale
    count = min(most, len(area))
    values, vectors = eigh(matrix, subset_by_index=(0, count - 1))
    functions = vectors * scale[:, None] * np.sqrt(area.sum())
    return Harmonics(functions, np.maximum(values, 0.0))
