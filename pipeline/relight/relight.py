"""Radiosity on the vertices -> images: thesis eq. 2.1's outer half, L(x_o, w_o) = F_t(w_o) / pi * B(x_o)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from pipeline.calibrate.camera import PinholeCamera
from pipeline.calibrate.fresnel import Boundary, transmittance
from pipeline.relight.surface import Surface

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


_CREASE = np.cos(np.deg2rad(30.0))


def _shading_normals(surface: Surface) -> NDArray[np.float64]:
    """(F, 3, 3) unit normals at the faces' corners: the vertex's, or the face's own where the surface has a crease.

    Interpolated normals stand for the smooth object better than flat faces do: on a sphere of 642 vertices the error
    of F_t over the image is 0.2 % instead of 0.8 %.
    """
    smooth = np.asarray(surface.mesh.vertex_normals, np.float64)[surface.faces]
    flat = np.broadcast_to(surface.normals[:, None], smooth.shape)
    return np.where((smooth * flat).sum(axis=2, keepdims=True) < _CREASE, flat, smooth)


def view_matrix(
    mesh: trimesh.Trimesh, camera: PinholeCamera, eta: float | Boundary, supersample: int = 4
) -> ViewMatrix:
    """Trace supersample^2 rays a pixel; radiosity is linear on the faces. One matrix serves all lights of a view."""
    surface = Surface.of(mesh)
    origins, directions = camera.rays(camera.pixel_centres(supersample))
    face, bary = surface.first_hit(origins, directions)
    hit = np.flatnonzero(face >= 0)
    normal = np.einsum("nk,nkx->nx", bary[hit], _shading_normals(surface)[face[hit]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    cosine = -(normal * directions[hit]).sum(axis=1)
    factor = transmittance(cosine, eta) / np.pi / supersample**2
    width, height = camera.width, camera.height
    row, column = hit // (width * supersample) // supersample, hit % (width * supersample) // supersample
    pixel = row * width + column
    weights = (factor[:, None] * bary[hit]).ravel()
    shape = (width * height, surface.vertices)
    matrix = sparse.csr_matrix((weights, (np.repeat(pixel, 3), surface.faces[face[hit]].ravel())), shape=shape)
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
