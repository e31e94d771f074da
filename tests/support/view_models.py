"""A small model with everything that the page computes: shadows, veins, directions, a rough boundary."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.distance import cdist

from pipeline.geometry.fresnel import Boundary
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel

SLOPES = {"tilt": np.array([[0.4, 0.7, 0.3], [0.3, 0.6, 0.2]]), "tilt_distance": np.array([1.0, 6.0, 20.0])}


def model_on(mesh: trimesh.Trimesh, boundary: Boundary | None = None) -> RelightableModel:
    """Two wavelengths; R_d falls over four decades and differs from place to place."""
    points = np.asarray(mesh.vertices, np.float64)
    distance, dark = cdist(points, points), np.exp(-0.5 * (np.sin(points[:, 0] / 3) > 0.3))
    entries = [np.outer(dark, dark) * (0.02 * np.exp(-distance / w) + 1e-5) for w in (4.0, 3.0)]
    term = GlobalTerm(np.array(entries, np.float32), np.ones(distance.shape, bool), **SLOPES)
    return RelightableModel(mesh, boundary or Boundary(1.3, (0.0, 0.1, 0.5, 1.0), (4.0, 1.3, 1.0, 0.98)), (term,))


def dented() -> trimesh.Trimesh:
    """A ball of 15 mm with dents that shade themselves, 162 vertices."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    x, y, z = ball.vertices.T
    radius = 15 * (1 + 0.16 * np.sin(4 * x + 1) * np.sin(3 * y) + 0.14 * np.cos(5 * z + 2 * x))
    return trimesh.Trimesh(ball.vertices * radius[:, None], ball.faces, process=False)
