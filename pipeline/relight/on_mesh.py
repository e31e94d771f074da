"""What the terms of a model share for a light and for a view, worked out once and when it is first asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from hw.base.arrays import F32, F64
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import Boundary, along_surface, transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.pixel_footprints import SurfaceHits, trace_pixels
from pipeline.relight.irradiance import flux_of, hat_moments, tilted_moments
from pipeline.relight.lights import Light

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class LightOnMesh:
    """A light on a mesh with a boundary, for L lasers."""

    light: Light
    mesh: trimesh.Trimesh
    boundary: Boundary
    lasers: int

    @cached_property
    def moments(self) -> F64:
        """(L, V) W: integrals of the vertices' hat functions times the transmitted flux density."""
        if "tilted_moments" in vars(self):  # they hold these: light from many directions takes seconds
            return np.asarray(self.tilted_moments[0])
        return hat_moments(self.light, self.mesh, self.boundary, self.lasers)

    @cached_property
    def flux(self) -> F64:
        """(L, V) W transmitted at the vertices: the moments' projection (`irradiance.flux_of`)."""
        return flux_of(self.moments, self.mesh)

    @cached_property
    def tilted_flux(self) -> F64:
        """(4, L, V) W: the flux, and the flux times the mean of t, the refracted direction along the surface."""
        return np.stack([flux_of(m, self.mesh) for m in self.tilted_moments])

    @cached_property
    def tilted_moments(self) -> F64:
        """(4, L, V) W: `moments`, and the same with the mean of t in the integral."""
        return tilted_moments(self.light, self.mesh, self.boundary, self.lasers)


@dataclass(frozen=True, eq=False)
class ViewOfMesh:
    """A camera's view of a mesh with a boundary, sampled by supersample^2 rays a pixel."""

    camera: PinholeCamera
    mesh: trimesh.Trimesh
    boundary: Boundary
    supersample: int = 4

    def rays(self) -> Iterator[SurfaceHits]:
        """Where the rays of all pixels meet the surface, some whole rows of pixels at a time. Traced anew, not kept."""
        return trace_pixels(self.mesh, self.camera, self.supersample)

    def weight(self, rays: SurfaceHits) -> F64:
        """(N,) 1/sr: radiance that a ray adds to its pixel per radiosity where it meets the surface.

        The outer half of thesis eq. 2.1: L(x_o, w_o) = F_t(w_o) / pi * B(x_o).
        """
        return np.asarray(transmittance(rays.cosine, self.boundary) / np.pi / self.supersample**2)

    @cached_property
    def matrix(self) -> sparse.csr_matrix:
        """(H * W, V) 1/sr: radiance of a pixel per radiosity of a vertex, linear on the faces; pixels row by row."""
        return self._matrices(tilted=False)[0]

    @cached_property
    def tilted_matrices(self) -> tuple[sparse.csr_matrix, ...]:
        """Three matrices like `matrix`, with t of the refracted direction to the camera by component in the weight."""
        return self._matrices(tilted=True)

    def _matrices(self, tilted: bool) -> tuple[sparse.csr_matrix, ...]:
        shape, sums = (self.camera.height * self.camera.width, len(self.mesh.vertices)), []
        surface, eta = RayMesh.of(self.mesh), self.boundary.eta
        for rays in self.rays():
            at = np.repeat(rays.pixel, 3), self.mesh.faces[rays.triangle].ravel()
            weights = self.weight(rays)[None]
            if tilted:
                normal = surface.smooth_normals(rays.triangle, rays.barycentric)
                weights = weights * along_surface(-rays.direction, normal, eta).T
            shares = (weights[:, :, None] * rays.barycentric).reshape(len(weights), -1)
            sums.append([sparse.csr_matrix((s, at), shape=shape).tocoo() for s in shares])  # a tenth of the rays' size
        return tuple(_joined(parts, shape) for parts in zip(*sums, strict=True))

    def image(self, radiosity: F64, squared: bool = False) -> F32:
        """(L, V) radiosity in W/mm^2 -> (L, H, W) radiance in W/(mm^2 sr), averaged over each pixel.

        squared: the radiosity's variance at the vertices -> that of the radiance, for independent errors
        """
        matrix = self.matrix.power(2) if squared else self.matrix
        flat = np.asarray(matrix @ np.asarray(radiosity, np.float64).T)
        return np.moveaxis(flat.reshape(self.camera.height, self.camera.width, -1), -1, 0).astype(np.float32)


def _joined(parts: Sequence[sparse.coo_matrix], shape: tuple[int, int]) -> sparse.csr_matrix:
    """The sum of matrices whose rows do not overlap."""
    value, row, column = (np.concatenate([getattr(p, name) for p in parts]) for name in ("data", "row", "col"))
    return sparse.csr_matrix((value, (row, column)), shape=shape)
