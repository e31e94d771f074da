"""From an image to the surface: what the rays through its pixels meet. The way back: `image_operators`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import trimesh

from hw.base.arrays import F64, I64
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.mesh import RayMesh

BAND = 16  # rows of pixels whose rays are cast together: what is worked out for them stays in the cache
AROUND = 2  # pixels around the mesh's outline that still belong to a view's window


@dataclass(frozen=True)
class SurfaceHits:
    """Where N rays meet the surface; rays that miss it are left out.

    pixel: (N,) flat pixel index; triangle: (N,); barycentric: (N, 3); direction: (N, 3) of the ray; distance: (N,) mm
    along it; cosine: (N,) of the direction to the camera with the interpolated normal
    """

    pixel: I64
    triangle: I64
    barycentric: F64
    direction: F64
    distance: F64
    cosine: F64


def window(mesh: trimesh.Trimesh, camera: PinholeCamera) -> tuple[slice, slice]:
    """The (rows, columns) of the image that can show the mesh: not empty, and all of it where that is not certain."""
    corner, depth = camera.project(np.asarray(mesh.vertices))
    if not (np.isfinite(corner).all() and (depth > 0).all()):
        return slice(0, camera.height), slice(0, camera.width)
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(corner.min(axis=0)).astype(int) - AROUND, 0, size - 1)
    high = np.clip(np.ceil(corner.max(axis=0)).astype(int) + AROUND, low + 1, size)
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def trace_pixels(mesh: trimesh.Trimesh, camera: PinholeCamera, supersample: int) -> Iterator[SurfaceHits]:
    """What supersample^2 rays a pixel meet, some whole rows of pixels at a time, from the top."""
    surface, s = RayMesh.of(mesh), supersample
    rows, columns = window(mesh, camera)
    column = np.arange(columns.start * s, columns.stop * s)
    for first in range(rows.start, rows.stop, BAND):
        row = np.arange(first * s, min(first + BAND, rows.stop) * s)
        centres = np.stack(np.meshgrid((column + 0.5) / s, (row + 0.5) / s), axis=-1).reshape(-1, 2)
        origins, directions = camera.rays(centres)
        hit = surface.first_hit(origins, directions)
        index = np.flatnonzero(hit.triangle >= 0)
        triangle, barycentric, direction = hit.triangle[index], hit.barycentric[index], directions[index]
        cosine = -np.einsum("ni,ni->n", surface.smooth_normals(triangle, barycentric), direction)
        pixel = row[index // len(column)] // s * camera.width + column[index % len(column)] // s
        yield SurfaceHits(pixel, triangle, barycentric, direction, hit.distance[index], cosine)
