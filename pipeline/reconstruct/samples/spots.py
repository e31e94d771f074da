"""Where the laser spots lie on the scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from hw.base.arrays import F64, I64
from pipeline.calibrate.calibration import Calibration
from pipeline.geometry.fresnel import along_surface, transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.plan.plan import Plan
from pipeline.reconstruct.settings import ReconstructConfig


@dataclass(frozen=True)
class Spots:
    """Where the beam's axis meets the scan. All of length S, object frame, mm.

    transmitted: F_t(w_i), 0 for spots that are not used (the beam misses the scan or meets it too obliquely)
    """

    position: F64  # (S, 3)
    direction: F64  # (S, 3) unit, of travel
    normal: F64  # (S, 3) unit
    triangle: I64  # (S,)
    barycentric: F64  # (S, 3)
    transmitted: F64  # (S,)
    beam_radius: float


def locate_spots(mesh: trimesh.Trimesh, calibration: Calibration, plan: Plan, settings: ReconstructConfig) -> Spots:
    """Meet the calibrated beam axes with the scan."""
    origins, direction = calibration.spot_rays(plan.spots)
    surface = RayMesh.of(mesh)
    hit = surface.first_hit(origins, direction)
    triangle = np.maximum(hit.triangle, 0)
    barycentric = np.where(hit.triangle[:, None] >= 0, hit.barycentric, 1.0 / 3.0)
    normal = surface.smooth_normals(triangle, barycentric)
    cosine = -(normal * direction).sum(axis=1)
    used = (hit.triangle >= 0) & (cosine > np.cos(np.deg2rad(settings.max_incidence_deg)))
    position = surface.points(triangle, barycentric)
    transmitted = np.where(used, transmittance(cosine, settings.eta), 0.0)
    radius = calibration.projectors[0].beam_diameter_mm / 2
    return Spots(position, direction, normal, triangle, barycentric, transmitted, radius)


def tilts(mesh: trimesh.Trimesh, spots: Spots, eye: F64, eta: float) -> tuple[F64, F64]:
    """(t . e) of `pipeline.model.tilt` between spots and vertices, looked at from `eye`: (S, V) where light leaves, at
    the vertices, and (S, V) where it enters, at the spots.
    """
    points, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    way = points[None] - spots.position[:, None]
    way /= np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-9)
    to_eye = eye - points
    to_eye /= np.linalg.norm(to_eye, axis=1, keepdims=True)
    leaving = along_surface(to_eye, normals, eta)
    entering = along_surface(spots.direction, spots.normal, eta)
    return np.einsum("svx,vx->sv", way, leaving), np.einsum("svx,sx->sv", way, entering)
