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
from numpy.typing import NDArray
from scipy import ndimage, sparse

from pipeline.calibrate.camera import PinholeCamera
from pipeline.calibrate.fresnel import transmittance
from pipeline.reconstruct.mesh import first_hit, interpolated_normals, vertex_areas

F64 = NDArray[np.float64]

SUPERSAMPLE = 4  # rays per pixel and axis
JUMP = 8.0  # depth range inside a pixel, in pixel widths on the surface, that betrays a discontinuity


@dataclass(frozen=True)
class Reading:
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

    pixel: NDArray[np.int64]
    vertices: NDArray[np.int64]
    barycentric: F64
    area: F64
    cosine: F64


def see_surface(mesh: trimesh.Trimesh, camera: PinholeCamera, max_view_deg: float) -> Pixels:
    """The samples whose whole pixel, and its neighbours, show one continuous piece of surface, not too obliquely."""
    s, shape = SUPERSAMPLE, (camera.height, camera.width)
    origins, directions = camera.rays(camera.pixel_centres(s))
    hit = first_hit(mesh, origins, directions)
    index = np.flatnonzero(hit.triangle >= 0)
    triangle, barycentric = hit.triangle[index], hit.barycentric[index]
    direction, distance = directions[index], hit.distance[index]
    cosine = -(interpolated_normals(mesh, triangle, barycentric) * direction).sum(axis=1)
    flat = -(mesh.face_normals[triangle] * direction).sum(axis=1)
    refined_row, refined_column = np.divmod(index, camera.width * s)
    pixel = refined_row // s * camera.width + refined_column // s

    # A pinhole's solid angle per sample; distortion changes it by less than the scan's own errors.
    forward = (direction @ camera.pose[:3, :3].T)[:, 2]
    area = distance**2 * forward**3 / (camera.focal.prod() * s**2) / np.maximum(flat, 0.05)
    count = np.bincount(pixel, minlength=shape[0] * shape[1])
    near, far = np.full(count.shape, np.inf), np.full(count.shape, -np.inf)
    np.minimum.at(near, pixel, distance)
    np.maximum.at(far, pixel, distance)
    width = np.median(distance, axis=0) / camera.focal.mean() if len(distance) else 1.0
    broken = (count > 0) & (far - near > JUMP * width)
    unsafe = ndimage.binary_dilation((broken | (count < s * s)).reshape(shape), np.ones((3, 3), bool)).ravel()
    keep = ~unsafe[pixel] & (np.minimum(cosine, flat) > np.cos(np.deg2rad(max_view_deg)))
    return Pixels(pixel[keep], mesh.faces[triangle[keep]], barycentric[keep], area[keep], cosine[keep])


def footprint_reading(mesh: trimesh.Trimesh, camera: PinholeCamera, eta: float, max_view_deg: float) -> Reading:
    """Each vertex by the area-weighted mean of its hat function over the image."""
    seen = see_surface(mesh, camera, max_view_deg)
    size = (len(mesh.vertices), camera.height * camera.width)
    weight = seen.area[:, None] * seen.barycentric
    vertex, pixel = seen.vertices.ravel(), np.repeat(seen.pixel, 3)
    area = np.bincount(vertex, weight.ravel(), minlength=size[0])
    cosine = np.bincount(vertex, (weight * seen.cosine[:, None]).ravel(), minlength=size[0])
    value = (weight / transmittance(seen.cosine, eta)[:, None]).ravel() / area[vertex].clip(1e-12)
    operator = sparse.coo_array((value, (vertex, pixel)), shape=size).tocsr()
    share = np.minimum(area / vertex_areas(mesh), 1.0)
    return Reading(operator, share, cosine / area.clip(1e-12))


def bilinear_reading(mesh: trimesh.Trimesh, camera: PinholeCamera, eta: float, max_view_deg: float) -> Reading:
    """Each vertex by one bilinear look-up at its projection (thesis 5.3.1)."""
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    position, _ = camera.project(vertices)
    to_camera = camera.position - vertices
    distance = np.linalg.norm(to_camera, axis=1)
    to_camera /= distance[:, None]
    cosine = (normals * to_camera).sum(axis=1)
    lift = 1e-3 * np.sqrt(vertex_areas(mesh))[:, None]
    blocked = first_hit(mesh, vertices + lift * normals, to_camera).triangle >= 0
    corner = np.floor(position - 0.5).astype(np.int64)
    fraction = position - 0.5 - corner
    inside = ((corner >= 0) & (corner + 1 < [camera.width, camera.height])).all(axis=1)
    seen = np.flatnonzero(inside & ~blocked & (cosine > np.cos(np.deg2rad(max_view_deg))))
    x, y = corner[seen].T
    fx, fy = fraction[seen].T
    pixel = np.concatenate([(y + j) * camera.width + x + i for j in (0, 1) for i in (0, 1)])
    weight = np.concatenate([(fy if j else 1 - fy) * (fx if i else 1 - fx) for j in (0, 1) for i in (0, 1)])
    value = weight / np.tile(transmittance(cosine[seen], eta), 4)
    size = (len(vertices), camera.height * camera.width)
    operator = sparse.coo_array((value, (np.tile(seen, 4), pixel)), shape=size).tocsr()
    share = np.zeros(len(vertices))
    share[seen] = 1.0
    return Reading(operator, share, np.where(share > 0, cosine, 0.0))
