"""What the terms of a model share for a light and for a view, worked out once and when it is first asked for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from hw.base.arrays import F32, F64
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import Boundary, transmittance
from pipeline.geometry.pixel_footprints import SurfaceHits, trace_pixels
from pipeline.relight.irradiance import flux_of, hat_moments
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
        return hat_moments(self.light, self.mesh, self.boundary, self.lasers)

    @cached_property
    def flux(self) -> F64:
        """(L, V) W transmitted at the vertices: the moments' projection (`irradiance.flux_of`)."""
        return flux_of(self.moments, self.mesh)


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
        shape, sums = (self.camera.height * self.camera.width, len(self.mesh.vertices)), []
        for rays in self.rays():
            at = np.repeat(rays.pixel, 3), self.mesh.faces[rays.triangle].ravel()
            share = (self.weight(rays)[:, None] * rays.barycentric).ravel()
            sums.append(sparse.csr_matrix((share, at), shape=shape).tocoo())  # a tenth of the rays' size
        value, pixel, vertex = (np.concatenate([getattr(s, name) for s in sums]) for name in ("data", "row", "col"))
        return sparse.csr_matrix((value, (pixel, vertex)), shape=shape)

    def image(self, radiosity: F64, squared: bool = False) -> F32:
        """(L, V) radiosity in W/mm^2 -> (L, H, W) radiance in W/(mm^2 sr), averaged over each pixel.

        squared: the radiosity's variance at the vertices -> that of the radiance, for independent errors
        """
        matrix = self.matrix.power(2) if squared else self.matrix
        flat = np.asarray(matrix @ np.asarray(radiosity, np.float64).T)
        return np.moveaxis(flat.reshape(self.camera.height, self.camera.width, -1), -1, 0).astype(np.float32)
