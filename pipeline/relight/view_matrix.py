"""Radiosity on the vertices -> images: thesis eq. 2.1's outer half, L(x_o, w_o) = F_t(w_o) / pi * B(x_o)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import Boundary, transmittance
from pipeline.geometry.pixel_footprints import trace_pixels

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True)
class ViewMatrix:
    """A camera's view of a mesh, once for all lights.

    matrix:   (H * W, V) sparse, 1/sr: radiance of a pixel per radiosity of a vertex; pixels row by row
    coverage: (H, W) share of the pixel that the object fills, 0..1
    """

    matrix: sparse.csr_matrix
    coverage: NDArray[np.float64]

    def image(self, radiosity: NDArray[np.float64]) -> NDArray[np.float32]:
        """(L, V) radiosity in W/mm^2 -> (L, H, W) radiance in W/(mm^2 sr), averaged over each pixel."""
        flat = np.asarray(self.matrix @ np.asarray(radiosity, np.float64).T)
        return np.moveaxis(flat.reshape(*self.coverage.shape, -1), -1, 0).astype(np.float32)


def view_matrix(
    mesh: trimesh.Trimesh, camera: PinholeCamera, eta: float | Boundary, supersample: int = 4
) -> ViewMatrix:
    """Trace supersample^2 rays a pixel; radiosity is linear on the faces. One matrix serves all lights of a view."""
    bands = [(b.pixel, b.triangle, b.barycentric, b.cosine) for b in trace_pixels(mesh, camera, supersample)]
    pixel, face, barycentric, cosine = (np.concatenate(x) for x in zip(*bands, strict=True))
    factor = transmittance(cosine, eta) / np.pi / supersample**2
    width, height = camera.width, camera.height
    weights = (factor[:, None] * barycentric).ravel()
    shape = (width * height, len(mesh.vertices))
    matrix = sparse.csr_matrix((weights, (np.repeat(pixel, 3), mesh.faces[face].ravel())), shape=shape)
    coverage = np.bincount(pixel, minlength=width * height).reshape(height, width) / supersample**2
    return ViewMatrix(matrix, coverage)


def relit_image(
    radiosity: NDArray[np.float64],
    mesh: trimesh.Trimesh,
    camera: PinholeCamera,
    eta: float | Boundary,
    supersample: int = 4,
) -> NDArray[np.float32]:
    """(L, V) radiosity in W/mm^2 -> (L, H, W) radiance in W/(mm^2 sr). For several lights keep the `view_matrix`."""
    return view_matrix(mesh, camera, eta, supersample).image(radiosity)
