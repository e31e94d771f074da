"""From a scene to the object that light is traced through, and to the scan that the pipeline is given."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import trimesh

from disco_twin.object import shapes
from disco_twin.object.media import Medium, build_medium
from disco_twin.object.mesh import hat_basis, remesh
from disco_twin.object.schema import Box, ObjectConfig, Pebble, Sphere, Torus
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
    return TwinObject(mesh, boundary, build_medium(config.medium, mesh, len(scene.rig.lasers)))


def build_scan(scene: Scene, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh that the pipeline is given: `mesh` itself, or one of about `scan.vertices` vertices."""
    return mesh if scene.scan.vertices is None else remesh(mesh, scene.scan.vertices)


def _mesh(config: ObjectConfig) -> trimesh.Trimesh:
    shape = config.shape
    if isinstance(shape, Pebble):
        return shapes.pebble(shape)
    if isinstance(shape, Sphere):
        return shapes.sphere(shape)
    if isinstance(shape, Box):
        return shapes.box(shape)
    if isinstance(shape, Torus):
        return shapes.torus(shape)
    raise NotImplementedError(shape.kind)
