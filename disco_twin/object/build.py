"""From a scene to the object that light is traced through, and to the scan that the pipeline is given."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import trimesh

from disco_twin.object import shapes
from disco_twin.object.media import Medium, build_medium
from disco_twin.object.mesh import hat_basis, read_mesh, remesh
from disco_twin.object.schema import Box, MeshFile, ObjectConfig, Pebble, Sphere
from disco_twin.scene import Scene

__all__ = ["Boundary", "Medium", "TwinObject", "build_object", "build_scan", "hat_basis"]


@dataclass(frozen=True)
class Boundary:
    """Rough (GGX, `alpha`) or smooth dielectric of relative index `eta`; matched: no boundary, eta = 1."""

    kind: Literal["rough", "smooth", "matched"]
    eta: float
    alpha: float


@dataclass(frozen=True)
class TwinObject:
    """A closed mesh (object frame, mm), its boundary and the medium inside."""

    mesh: trimesh.Trimesh
    boundary: Boundary
    medium: Medium


def build_object(scene: Scene) -> TwinObject:
    """The object of a scene."""
    config = scene.object
    mesh = _mesh(config)
    kind = config.boundary.kind
    boundary = Boundary(
        kind, 1.0 if kind == "matched" else config.boundary.eta, config.boundary.alpha if kind == "rough" else 0.0
    )
    wavelengths = [laser.wavelength_nm for laser in scene.rig.lasers]
    return TwinObject(mesh, boundary, build_medium(config.medium, mesh, wavelengths))


def build_scan(scene: Scene, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh that the pipeline is given: `mesh` itself, or one of about `scan.vertices` vertices."""
    vertices, shape = scene.scan.vertices, scene.object.shape
    if vertices is None:
        return mesh
    if isinstance(shape, Box):
        return shapes.box(shape, triangles=2 * vertices)  # keeps the edges sharp
    return remesh(mesh, vertices)


def _mesh(config: ObjectConfig) -> trimesh.Trimesh:
    shape = config.shape
    if isinstance(shape, MeshFile):
        return read_mesh(shape.file)
    if isinstance(shape, Pebble):
        return shapes.pebble(shape)
    if isinstance(shape, Sphere):
        return shapes.sphere(shape)
    if isinstance(shape, Box):
        return shapes.box(shape)
    return shapes.torus(shape)
