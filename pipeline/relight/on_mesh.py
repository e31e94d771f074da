"""What the terms of a model share for a light and for a view, worked out once and when it is first asked for."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from hw.base.arrays import F32, F64
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import Boundary, transmittance
from pipeline.geometry.pixel_footprints import SurfaceHits, trace_pixels
from pipeline.relight.irradiance import transmitted_flux
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
    def flux(self) -> F64:
        """(L, V) W transmitted at the vertices (`irradiance.transmitted_flux`)."""
        return transmitted_flux(self.light, self.mesh, self.boundary, self.lasers)


@dataclass(frozen=True, eq=False)
class ViewOfMesh:
    """A camera's view of a mesh with a boundary, sampled by supersample^2 rays a pixel."""

    camera: PinholeCamera
    mesh: trimesh.Trimesh
    boundary: Boundary
    supersample: int = 4

    @cached_property
    def rays(self) -> SurfaceHits:
        """Where the rays of all pixels meet the surface, from the top; N of them."""
        bands = list(trace_pixels(self.mesh, self.camera, self.supersample))
        return SurfaceHits(*(np.concatenate([getattr(b, f.name) for b in bands]) for f in fields(SurfaceHits)))

    @cached_property
    def weight(self) -> F64:
        """(N,) 1/sr: radiance that a ray adds to its pixel per radiosity where it meets the surface.

        The outer half of thesis eq. 2.1: L(x_o, w_o) = F_t(w_o) / pi * B(x_o).
        """
        return np.asarray(transmittance(self.rays.cosine, self.boundary) / np.pi / self.supersample**2)

    @cached_property
    def matrix(self) -> sparse.csr_matrix:
        """(H * W, V) 1/sr: radiance of a pixel per radiosity of a vertex, linear on the faces; pixels row by row."""
        rays, shape = self.rays, (self.camera.height * self.camera.width, len(self.mesh.vertices))
        at = np.repeat(rays.pixel, 3), self.mesh.faces[rays.triangle].ravel()
        return sparse.csr_matrix(((self.weight[:, None] * rays.barycentric).ravel(), at), shape=shape)

    def image(self, radiosity: F64) -> F32:
        """(L, V) radiosity in W/mm^2 -> (L, H, W) radiance in W/(mm^2 sr), averaged over each pixel."""
        flat = np.asarray(self.matrix @ np.asarray(radiosity, np.float64).T)
        return np.moveaxis(flat.reshape(self.camera.height, self.camera.width, -1), -1, 0).astype(np.float32)
