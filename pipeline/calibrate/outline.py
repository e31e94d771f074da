"""The outline of the scan in an image, and where the image itself shows the edge, to a few hundredths of a pixel.

An edge is fitted along the outline's normal: background, then a step, then a shading that rises with the square root
of the depth, as it does at every smooth rim; all blurred by the pixel. A threshold would be off by a tenth of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage, special

from hw.base.arrays import F64, I64, Bool
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.mesh import RayMesh

PIXEL_BLUR = 12**-0.5  # standard deviation of a pixel's own box, in pixels
INSIDE, OUTSIDE, SPACING = 4.0, 3.0, 0.5  # pixels along the normal that an edge is fitted to
REACH, GRID = 2.0, 0.05  # an edge is looked for within this distance of the outline, in these steps
CLEAR = 0.7  # pixels outside the outline where nothing of the object may be
SHARP_RAD = 0.5  # between the triangles at an edge of the object's own; below, they stand for a smooth surface
SUPERSAMPLE = 4  # rays per pixel and axis of a synthetic image, this many pixels to either side of its rim:
RIM_PX = 12  # as far as an edge is fitted, and where the spline through the pixels no longer tells
NOISY = 0.25  # an edge whose model leaves more than this share of its height is not used


@dataclass(frozen=True)
class Outline:
    """Points of the mesh that lie on its outline. points: (K, 3) object frame; pixel, normal: (K, 2), normal outward.

    across: (K, 3) the surface's unit normal in the camera's frame; only motion along it moves the outline
    length: (K,) pixels of the outline that each stands for
    ends: (K, 2) vertices between which each lies; shares: (K, 2) values of their hat functions there
    """

    points: F64
    pixel: F64
    normal: F64
    across: F64
    length: F64
    ends: I64
    shares: F64


def outline(mesh: trimesh.Trimesh, camera: PinholeCamera) -> Outline:
    """Outer contour of the mesh's projection; camera in the object frame. Edges inside the silhouette are left out."""
    towards = mesh.triangles_center - camera.position
    front = (mesh.face_normals * towards).sum(axis=1) < 0
    pairs, edges = mesh.face_adjacency, mesh.face_adjacency_edges
    rim = front[pairs[:, 0]] != front[pairs[:, 1]]
    vertices = np.asarray(edges[rim], np.int64)
    ends = np.asarray(mesh.vertices)[vertices]  # (E, 2, 3)
    facing = np.where(front[pairs[rim, 0]], pairs[rim, 0], pairs[rim, 1])
    smooth = np.asarray(mesh.vertex_normals)[edges[rim]] @ camera.pose[:3, :3].T  # (E, 2, 3), camera's frame
    sharp = mesh.face_adjacency_angles[rim] > SHARP_RAD
    pixel = np.stack([camera.project(ends[:, k])[0] for k in (0, 1)], axis=1)
    size = np.linalg.norm(pixel[:, 1] - pixel[:, 0], axis=1)
    keep = size > 1e-6
    ends, facing, pixel, size, smooth, sharp, vertices = (
        x[keep] for x in (ends, facing, pixel, size, smooth, sharp, vertices)
    )
    parts = np.maximum(np.ceil(size), 1).astype(int)
    index = np.repeat(np.arange(len(parts)), parts)
    share = (np.arange(len(index)) - np.repeat(np.cumsum(parts) - parts, parts) + 0.5) / parts[index]
    shares = np.column_stack([1 - share, share])
    points = (ends[index] * shares[:, :, None]).sum(axis=1)
    along = (pixel[:, 1] - pixel[:, 0]) / size[:, None]
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    inward = camera.project(np.asarray(mesh.triangles_center)[facing])[0] - pixel.mean(axis=1)
    normal *= -np.sign((normal * inward).sum(axis=1))[:, None]
    # A rim of a finely faceted surface zigzags, the surface's own normal does not.
    across = _unit((smooth[index] * shares[:, :, None]).sum(axis=1))
    at, length = camera.project(points)[0], (size / parts)[index]
    rays = camera.undistort((at - camera.centre) / camera.focal)
    flat = normal[index]  # of the plane through the eye and a sharp edge
    flat = _unit(np.column_stack([flat, -(flat * rays).sum(axis=1)]))
    across = np.where(sharp[index, None], flat, across)
    normal = _unit(across[:, :2])
    outer = ~RayMesh.of(mesh).meets(*camera.rays(at + CLEAR * normal))
    return Outline(
        points[outer], at[outer], normal[outer], across[outer], length[outer], vertices[index][outer], shares[outer]
    )


def _unit(vectors: F64) -> F64:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


@lru_cache(maxsize=1)
def _edge_models() -> tuple[F64, F64, F64]:
    """(M,) offsets along the normal, (E,) edge positions, (E, M, 3) orthonormal bases of step, shading, background."""
    offset, edge = np.arange(-INSIDE, OUTSIDE + 1e-9, SPACING), np.arange(-REACH, REACH + 1e-9, GRID)
    nodes, weights = np.polynomial.hermite_e.hermegauss(41)
    depth = edge[:, None] - offset
    step = special.ndtr(depth / PIXEL_BLUR)
    shading = (np.sqrt(np.maximum(depth[..., None] + PIXEL_BLUR * nodes, 0)) * weights).sum(axis=2) / weights.sum()
    bases = np.stack([step, shading, np.ones_like(step)], axis=2)
    return offset, edge, np.linalg.qr(bases)[0]


def edges_along(image: NDArray[np.floating], pixel: F64, normal: F64) -> tuple[F64, Bool]:
    """(K,) pixels outward of (K, 2) `pixel` at which the image's edge crosses each of (K, 2) normals, (K,) if found."""
    offset, edge, bases = _edge_models()
    at = pixel[:, None] + offset[:, None] * normal[:, None]
    spline = ndimage.spline_filter(np.asarray(image, np.float64), mode="nearest")
    value = ndimage.map_coordinates(spline, [at[..., 1] - 0.5, at[..., 0] - 0.5], mode="nearest", prefilter=False)
    total = (value**2).sum(axis=1)
    explained = (np.einsum("emb,km->ekb", bases, value) ** 2).sum(axis=2)  # (E, K)
    best = np.clip(explained.argmax(axis=0), 1, len(edge) - 2)
    k = np.arange(len(pixel))
    before, here, after = explained[best - 1, k], explained[best, k], explained[best + 1, k]
    bend = before - 2 * here + after
    found = edge[best] + GRID * np.where(bend < 0, 0.5 * (before - after) / np.minimum(bend, -1e-300), 0.0)
    height = value[:, offset <= -1].mean(axis=1) - value[:, offset >= 2].mean(axis=1)
    rest = np.sqrt(np.maximum(total - here, 0) / len(offset))
    edge_in_view = ((at > 0) & (at < [image.shape[1], image.shape[0]])).all(axis=(1, 2))
    good = (bend < 0) & (np.abs(found) < REACH - GRID) & (height > 0) & (rest < NOISY * height) & edge_in_view
    return np.clip(found, -REACH, REACH), good


def signed_distance(mask: Bool) -> F64:
    """(H, W) pixels from the mask's border, positive outside."""
    outside, inside = ndimage.distance_transform_edt(~mask), ndimage.distance_transform_edt(mask)
    return np.asarray(np.where(mask, 0.5 - inside, outside - 0.5))


def synthetic(mesh: trimesh.Trimesh, camera: PinholeCamera, image: NDArray[np.floating]) -> F64:
    """(H, W) the mesh as the camera would see it in the light of `image`.

    The light is taken from the image's own inside: a matt surface shows second-order spherical harmonics of its normal
    under any distant light (Ramamoorthi and Hanrahan 2001, eq. 12), nine coefficients by least squares.
    """
    shape, surface, s = (camera.height, camera.width), RayMesh.of(mesh), SUPERSAMPLE
    centres = camera.pixel_centres()
    seen = surface.meets(*camera.rays(centres)).reshape(shape)
    # Only near the rim is a pixel covered in part; the others are what their centres are.
    rim = ndimage.binary_dilation(seen, iterations=RIM_PX) & ~ndimage.binary_erosion(seen, iterations=RIM_PX)
    whole, partly = np.flatnonzero(seen & ~rim), np.flatnonzero(rim)
    within = (np.stack(np.meshgrid(*[np.arange(s)] * 2), axis=-1).reshape(-1, 2) + 0.5) / s - 0.5
    pixels = np.concatenate([centres[whole], (centres[partly, None] + within).reshape(-1, 2)])
    owner = np.concatenate([whole, np.repeat(partly, s * s)])
    found = surface.first_hit(*camera.rays(pixels))
    hit = np.flatnonzero(found.triangle >= 0)
    x, y, z = surface.smooth_normals(found.triangle[hit], found.barycentric[hit]).T
    basis = np.column_stack([np.ones_like(x), x, y, z, x * y, x * z, y * z, x * x - y * y, 3 * z * z - 1])
    size, rays = shape[0] * shape[1], np.maximum(np.bincount(owner, minlength=len(centres)), 1)
    mean = np.stack([np.bincount(owner[hit], b, minlength=size) for b in basis.T], axis=1) / rays[:, None]
    full = np.bincount(owner[hit], minlength=size) == rays
    inside = ndimage.binary_erosion(full.reshape(shape)).ravel()
    light = np.linalg.lstsq(mean[inside], np.asarray(image, np.float64).ravel()[inside], rcond=None)[0]
    return np.asarray(np.maximum(mean @ light, 0.0).reshape(shape))
