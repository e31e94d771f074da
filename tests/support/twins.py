"""Small objects and traces that the validation tests share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from disco_twin.light.sources import BeamSource
from disco_twin.light.transport import Traced, Transport
from disco_twin.object.build import Medium, TwinBoundary, TwinObject
from pipeline.geometry.camera import PinholeCamera, look_at

F64 = NDArray[np.float64]
Kind = Literal["rough", "smooth", "matched"]


def homogeneous(mesh: trimesh.Trimesh, sigma_t: float, albedo: ArrayLike, g: float = 0.0) -> Medium:
    """One voxel around the mesh; albedo: one value per wavelength."""
    albedo = np.atleast_1d(np.asarray(albedo, np.float32)).reshape(-1, 1, 1, 1)
    low, high = np.asarray(mesh.bounds, float)
    return Medium(np.full_like(albedo, sigma_t), albedo, low - 0.1, high + 0.1, (g,) * len(albedo))


def twin(
    mesh: trimesh.Trimesh, kind: Kind, eta: float, sigma_t: float, albedo: ArrayLike, g: float = 0.0, alpha: float = 0.3
) -> TwinObject:
    """A homogeneous object."""
    boundary = TwinBoundary(kind, 1.0 if kind == "matched" else eta, alpha if kind == "rough" else 0.0)
    return TwinObject(mesh, boundary, homogeneous(mesh, sigma_t, albedo, g))


def block(width: float, depth: float) -> trimesh.Trimesh:
    """A box of 12 triangles whose upper face lies in z = 0, its middle at the origin."""
    mesh = trimesh.creation.box(extents=[width, width, depth])
    mesh.apply_translation([0, 0, -depth / 2])
    return mesh


def beam(
    tags: int = 1, origin: Sequence[float] = (0.37, -0.21, 50.0), direction: Sequence[float] = (0, 0, -1.0),
    radius: float = 1e-3,
) -> Any:  # fmt: skip
    """A source maker for `Transport.trace`: the same 1 W beam for every tag and wavelength."""

    def make(group: Sequence[int]) -> BeamSource:
        return BeamSource(
            np.tile(origin, (tags, 1)), np.tile(direction, (tags, 1)), radius, np.ones((tags, len(group)))
        )

    return make


def escaped(transport: Transport, make: Any, replicates: int, walks: int, seed: int) -> tuple[F64, Traced]:
    """(replicates, L) power that left the object, and the whole trace."""
    traced = transport.trace(make, replicates, walks, seed=seed, deposit=True)
    assert traced.deposits is not None
    return traced.deposits.sum(axis=2), traced


def camera(position: ArrayLike, field: float, pixels: int, up: ArrayLike = (0.0, 1.0, 0.1)) -> PinholeCamera:
    """A square camera aimed at the origin that sees `field` mm there."""
    focal = pixels * float(np.linalg.norm(position)) / field
    return PinholeCamera(
        pixels, pixels, np.full(2, focal), np.full(2, pixels / 2), np.zeros(5), look_at(position, (0, 0, 0), up)
    )


def pixel_areas(view: PinholeCamera, normal: ArrayLike = (0.0, 0.0, 1.0)) -> F64:
    """(H, W) area in mm^2 that each pixel covers on the plane through the origin: distance^2 * solid angle / cosine."""
    origins, directions = view.rays(view.pixel_centres())
    normal = np.asarray(normal, float)
    slant = -directions @ normal
    distance = (origins @ normal) / slant
    axis = view.pose[2, :3]
    solid_angle = (directions @ axis) ** 3 / view.focal.prod()
    return np.asarray(distance**2 * solid_angle / slant).reshape(view.height, view.width)
