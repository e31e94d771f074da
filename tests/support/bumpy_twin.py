"""An object with bumps before cameras."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from disco_twin.object.build import Medium, TwinBoundary, TwinObject

F64 = NDArray[np.float64]


def bumpy(kind: str = "rough", alpha: float = 0.3, g: float = 0.4) -> TwinObject:
    """A body with dents, a heterogeneous medium and one wavelength; some 5 mm in radius."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    x, y, z = mesh.vertices.T
    mesh.vertices *= (5 * (1 + 0.15 * np.sin(3 * x + 1) * np.cos(2.5 * y) + 0.1 * np.sin(4 * z)))[:, None]
    low, high = np.asarray(mesh.bounds, float)
    random = np.random.default_rng(1)
    sigma_t = random.uniform(0.6, 3.0, (1, 5, 5, 5)).astype(np.float32)
    albedo = random.uniform(0.9, 1.0, sigma_t.shape).astype(np.float32)
    boundary = TwinBoundary(kind, 1.0 if kind == "matched" else 1.3, alpha if kind == "rough" else 0.0)  # type: ignore[arg-type]
    return TwinObject(mesh, boundary, Medium(sigma_t, albedo, low - 0.1, high + 0.1, (g,)))


SPOT = {"origin": (46.0, 0.0, 20.0), "direction": (-0.917026, 0.0, -0.398707), "radius": 0.5}


VIEWS = ((350.0, 0.0, 150.0), (100.0, 330.0, 100.0))  # from the spot's side, and across


def blocks(images: F64, side: int) -> F64:
    """(..., H, W) -> (..., H / side * W / side) sums over square blocks of pixels."""
    *front, height, width = images.shape
    cut = images.reshape(*front, height // side, side, width // side, side).sum(axis=(-3, -1))
    return cut.reshape(*front, -1)
