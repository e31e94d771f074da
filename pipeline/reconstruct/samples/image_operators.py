"""What can be computed once per view (thesis 5.2.1): which pixels say what about which vertex of the scan.

A vertex is read by the mean over its footprint: the pixels that see its hat function, weighted by hat and by the
surface area that they see, divided by the Fresnel transmittance towards the camera. Summed over vertices with their
areas this is the integral over the image, so a fully seen footprint conserves energy. The thesis's bilinear look-up
at the vertex is kept for the baseline.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy import ndimage, sparse

from hw.base.arrays import F64, I64, Bool
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.pixel_footprints import SurfaceHits, trace_pixels

SUPERSAMPLE = 4  # rays per pixel and axis
JUMP = 8.0  # depth range inside a pixel, in pixel widths on the surface, that betrays a discontinuity


@dataclass(frozen=True)
class ImageOperator:
    """How the vertices are read from one view's image.

    operator: (V, H * W), radiance image -> mean of radiance / F_t per vertex, same unit
    share: (V,) part of the vertex's hat that the view sees, 0..1; where it is 0 the operator's row is empty
    cosine: (V,) mean cosine between normal and direction to the camera
    """

    operator: sparse.csr_array
    share: F64
    cosine: F64


@dataclass(frozen=True)
class Pixels:
    """The surface behind each of N samples of the image. Only samples that are safe to read are listed.

    pixel: (N,) flat pixel index; vertices: (N, 3); barycentric: (N, 3); area: (N,) mm^2 of surface;
    cosine: (N,) with the interpolated normal
    """

    pixel: I64
    vertices: I64
    barycentric: F64
    area: F64
    cosine: F64


def see_surface(mesh: trimesh.Trimesh, camera: PinholeCamera, max_view_deg: float) -> Pixels:
    """The samples whose whole pixel, and its neighbours, show one continuous piece of surface, not too obliquely."""
    s, shape = SUPERSAMPLE, (camera.height, camera.width)
    bands = [
        (b.pixel, b.triangle, b.barycentric, b.distance, b.cosine, *_area(mesh, camera, b))
        for b in trace_pixels(mesh, camera, s)
    ]
    pixel, triangle, barycentric, distance, cosine, area, flat = (np.concatenate(x) for x in zip(*bands, strict=True))
    count = np.bincount(pixel, minlength=shape[0] * shape[1])
    near, far = np.full(count.shape, np.inf), np.full(count.shape, -np.inf)
    np.minimum.at(near, pixel, distance)
    np.maximum.at(far, pixel, distance)
    width = np.median(distance) / camera.focal.mean() if len(distance) else 1.0
    broken = (count > 0) & (far - near > JUMP * width)
    unsafe = ndimage.binary_dilation((broken | (count < s * s)).reshape(shape), np.ones((3, 3), bool)).ravel()
    facing = np.minimum(cosine, flat) > np.cos(np.deg2rad(max_view_deg))
    keep = np.flatnonzero(~unsafe[pixel] & facing)
    vertices = mesh.faces[triangle[keep]]
    return Pixels(pixel[keep], vertices, barycentric[keep], area[keep], cosine[keep])


def _area(mesh: trimesh.Trimesh, camera: PinholeCamera, seen: SurfaceHits) -> tuple[F64, F64]:
    """(N,) mm^2 of surface that each sample stands for, and its cosine with the triangle itself."""
    flat = -np.einsum("ni,ni->n", RayMesh.of(mesh).normals[seen.triangle], seen.direction)
    # A pinhole's solid angle per sample; distortion changes it by less than the scan's own errors.
    forward = seen.direction @ camera.pose[2, :3]
    pixels = camera.focal.prod() * SUPERSAMPLE**2
    return seen.distance**2 * forward**3 / pixels / np.maximum(flat, 0.05), flat


def footprint_reading(mesh: trimesh.Trimesh, camera: PinholeCamera, eta: float, max_view_deg: float) -> ImageOperator:
    """Each vertex by the area-weighted mean of its hat function over the image."""
    seen = see_surface(mesh, camera, max_view_deg)
    size = (len(mesh.vertices), camera.height * camera.width)
    weight = seen.area[:, None] * seen.barycentric
    vertex, pixel = seen.vertices.ravel(), np.repeat(seen.pixel, 3)
    area = np.bincount(vertex, weight.ravel(), minlength=size[0])
    cosine = np.bincount(vertex, (weight * seen.cosine[:, None]).ravel(), minlength=size[0])
    value = (weight / transmittance(seen.cosine, eta)[:, None]).ravel() / area[vertex].clip(1e-12)
    operator = sparse.coo_array((value, (vertex, pixel)), shape=size).tocsr()
    share = np.minimum(area / RayMesh.of(mesh).vertex_areas, 1.0)
    return ImageOperator(operator, share, cosine / area.clip(1e-12))


@dataclass(frozen=True)
class ImagePoints:
    """Where N points of the surface lie in a view's image. pixel: (N, 2) x, y; cosine: (N,) with the direction to the
    camera; visible: (N,) whether the camera sees them: in the image, facing it, nothing in between
    """

    pixel: F64
    cosine: F64
    visible: Bool


def image_points(mesh: trimesh.Trimesh, camera: PinholeCamera, points: F64, normals: F64, lift: F64) -> ImagePoints:
    """(N, 3) points of the mesh in mm with (N, 3) unit normals, be they vertices or an atlas's texels.

    lift: (N,) mm along the normal from where the camera is looked for, lest a point hide itself
    """
    pixel, _ = camera.project(points)
    to_camera = camera.position - points
    to_camera /= np.linalg.norm(to_camera, axis=1)[:, None]
    cosine = np.einsum("ni,ni->n", normals, to_camera)
    inside = ((pixel >= 0.5) & (pixel <= np.array([camera.width, camera.height]) - 0.5)).all(axis=1)
    visible = inside & (cosine > 0)
    some = np.flatnonzero(visible)
    lifted = points[some] + lift[some, None] * normals[some]
    visible[some] = RayMesh.of(mesh).first_hit(lifted, to_camera[some]).triangle < 0
    return ImagePoints(pixel, cosine, visible)


def bilinear_reading(mesh: trimesh.Trimesh, camera: PinholeCamera, eta: float, max_view_deg: float) -> ImageOperator:
    """Each vertex by one bilinear look-up at its projection (thesis 5.3.1)."""
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    found = image_points(mesh, camera, vertices, normals, 1e-3 * np.sqrt(RayMesh.of(mesh).vertex_areas))
    cosine = found.cosine
    seen = np.flatnonzero(found.visible & (cosine > np.cos(np.deg2rad(max_view_deg))))
    corner = np.zeros((len(vertices), 2), np.int64)
    last = [camera.width - 2, camera.height - 2]
    corner[seen] = np.minimum(np.floor(found.pixel[seen] - 0.5).astype(np.int64), last)
    fraction = found.pixel - 0.5 - corner
    x, y = corner[seen].T
    fx, fy = fraction[seen].T
    pixel = np.concatenate([(y + j) * camera.width + x + i for j in (0, 1) for i in (0, 1)])
    weight = np.concatenate([(fy if j else 1 - fy) * (fx if i else 1 - fx) for j in (0, 1) for i in (0, 1)])
    value = weight / np.tile(transmittance(cosine[seen], eta), 4)
    size = (len(vertices), camera.height * camera.width)
    operator = sparse.coo_array((value, (np.tile(seen, 4), pixel)), shape=size).tocsr()
    share = np.zeros(len(vertices))
    share[seen] = 1.0
    return ImageOperator(operator, share, np.where(share > 0, cosine, 0.0))


IMAGE_OPERATORS = {"footprint": footprint_reading, "bilinear": bilinear_reading}  # as methods ask for them
