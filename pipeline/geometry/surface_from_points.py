"""From a scanned point cloud to the mesh that everything else stands on (thesis 4.4, 5.3.1).

Screened Poisson reconstruction (Kazhdan and Hoppe 2013), then remeshing to triangles of nearly equal area (Botsch and
Kobbelt 2004): throughput factors are symmetric on those only.
"""

from __future__ import annotations

import gpytoolbox
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from hw.base.arrays import F64
from hw.base.errors import InputError

PSR_DEPTH = 7  # cells of 1/128 of the object's extent
SCREENING = 0.5  # weight of single points against smoothness: their noise is averaged
LEAST_POINTS = 800


def reconstruct_surface(points: F64, normals: F64, vertices: int) -> trimesh.Trimesh:
    """(N, 3) points in mm with (N, 3) outward normals -> a closed mesh, outward, of about `vertices` vertices.

    Raises: InputError for too few points, or points that no closed surface follows.
    """
    if len(points) < LEAST_POINTS:
        raise InputError("too few points", key="points", value=len(points), allowed=f"at least {LEAST_POINTS}",
                         remedy="scan more of the object")  # fmt: skip
    v, f = gpytoolbox.point_cloud_to_mesh(
        points.astype(np.float64), normals.astype(np.float64), psr_screening_weight=SCREENING, psr_depth=PSR_DEPTH
    )
    whole = max(trimesh.Trimesh(v, f, process=True).split(only_watertight=True), key=lambda m: m.volume, default=None)
    if whole is None:
        raise InputError("the points enclose no surface", key="points", remedy="scan the missing sides")
    edge = float(np.sqrt(whole.area / (2 * vertices) * 4 / np.sqrt(3)))
    mesh = whole
    for _ in range(6):
        start = (np.array(whole.vertices, np.float64), np.array(whole.faces, np.int32))
        mesh = trimesh.Trimesh(*gpytoolbox.remesh_botsch(*start, 20, edge, True), process=False)
        if abs(len(mesh.vertices) / vertices - 1) < 0.01:
            break
        edge *= float(np.sqrt(len(mesh.vertices) / vertices))
    if not (mesh.is_watertight and mesh.is_winding_consistent):
        raise InputError("no closed mesh of so few vertices", key="scan.vertices", value=vertices, remedy="raise it")
    if mesh.volume < 0:
        mesh.invert()
    for _ in range(2):  # chords of a curved surface lie inside it: push the vertices out until the points lie on it
        distance = _outside(mesh, points)
        nearest = cKDTree(mesh.vertices).query(points)[1]
        count = np.bincount(nearest, minlength=len(mesh.vertices))
        mean = np.bincount(nearest, distance, minlength=len(mesh.vertices)) / np.maximum(count, 1)
        pushed = mesh.vertices + mean[:, None] * mesh.vertex_normals
        mesh = trimesh.Trimesh(pushed, mesh.faces, process=False)
    return mesh


def _outside(mesh: trimesh.Trimesh, points: F64) -> F64:
    """(N,) signed distance of points from the mesh in mm, positive outside."""
    v, f = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int32)
    return np.asarray(gpytoolbox.signed_distance(points, v, f)[0], np.float64)
