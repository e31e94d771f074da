"""From a scanned point cloud to the mesh that everything else stands on (thesis 4.4, 5.3.1).

Screened Poisson reconstruction (Kazhdan and Hoppe 2013), then remeshing to triangles of nearly equal area (Botsch and
Kobbelt 2004): throughput factors are symmetric on those only. Both round edges, and triangles of a rounded edge zigzag
about it: where the points show that, the surface is reconstructed more finely, its edges are held while it is remeshed,
and the vertices are fitted to the points (docs/decisions/0126-edges-of-scanned-objects.md).
"""

from __future__ import annotations

import logging

import gpytoolbox
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from hw.base.arrays import F64
from hw.base.errors import InputError
from pipeline.geometry.mesh import arrays
from pipeline.geometry.remesh import fitted, is_sound, remesh

log = logging.getLogger(__name__)

PSR_DEPTH, SCREENING = 7, 0.5  # cells of 1/128 of the object's extent; weight of single points against smoothness
FINE_DEPTH, FINE_SCREENING = 8, 2.0  # where there are edges
LEAST_POINTS = 800
STIFFNESS = 0.1  # as strong as a tenth of a vertex's points: a corner's own few leave some directions open
OFF, MOST_OFF = 3.0, 0.01  # deviations of their noise; share of the points that may be off a rounded mesh by more


def reconstruct_surface(points: F64, normals: F64, vertices: int) -> trimesh.Trimesh:
    """(N, 3) points in mm with (N, 3) outward normals -> a closed mesh, outward, of about `vertices` vertices.

    Raises: InputError for too few points, or points that no closed surface follows.
    """
    if len(points) < LEAST_POINTS:
        raise InputError("too few points", key="points", value=len(points), allowed=f"at least {LEAST_POINTS}",
                         remedy="scan more of the object")  # fmt: skip
    rounded = _smooth(_enclosed(points, normals, PSR_DEPTH, SCREENING), points, vertices)
    off = np.abs(_outside(rounded, points))
    limit = OFF * 1.4826 * float(np.median(off))  # of normal noise
    missed = float((off > limit).mean())
    if missed <= MOST_OFF:
        return rounded
    fine = _enclosed(points, normals, FINE_DEPTH, FINE_SCREENING)
    try:
        edged = fitted(remesh(fine, vertices), points, np.ones(len(points)), STIFFNESS)
    except InputError as error:
        log.warning("the scan's edges are rounded: %s", error)
        return rounded
    left = float((np.abs(_outside(edged, points)) > limit).mean())
    log.info("scan: %.1f %% of the points are off a rounded mesh, %.1f %% off one with edges", 100 * missed, 100 * left)
    return edged if left < missed and is_sound(edged, fine) else rounded


def _enclosed(points: F64, normals: F64, depth: int, screening: float) -> trimesh.Trimesh:
    """The largest closed surface by screened Poisson reconstruction."""
    v, f = gpytoolbox.point_cloud_to_mesh(
        points.astype(np.float64), normals.astype(np.float64), psr_screening_weight=screening, psr_depth=depth
    )
    whole = max(trimesh.Trimesh(v, f, process=True).split(only_watertight=True), key=lambda m: m.volume, default=None)
    if whole is None:
        raise InputError("the points enclose no surface", key="points", remedy="scan the missing sides")
    return whole


def _smooth(whole: trimesh.Trimesh, points: F64, vertices: int) -> trimesh.Trimesh:
    """About so many vertices near a surface without edges."""
    edge = float(np.sqrt(whole.area / (2 * vertices) * 4 / np.sqrt(3)))
    mesh = whole
    for _ in range(6):
        mesh = trimesh.Trimesh(*gpytoolbox.remesh_botsch(*arrays(whole), 20, edge, True), process=False)
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
    return np.asarray(gpytoolbox.signed_distance(points, *arrays(mesh))[0], np.float64)
