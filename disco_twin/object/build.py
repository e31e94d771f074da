"""From a scene to the object that light is traced through, and to the scan that the pipeline is given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import trimesh

from disco_twin.object import shapes
from disco_twin.object.blend import blend
from disco_twin.object.bodies import OBJECT, Body, Named, OwnMedium, bodies_of, check_nesting, shells_of
from disco_twin.object.extrusion import extrusion
from disco_twin.object.media import Medium, build_medium
from disco_twin.object.mesh import hat_basis, read_mesh
from disco_twin.object.scanner import scan_points
from disco_twin.scene.object_schema import MOST_VERTICES
from disco_twin.scene.shape_schema import Blend, Box, Extrusion, MeshFile, Pebble, Shape, Sphere, Torus
from hw.base.errors import InputError
from pipeline.geometry.mesh_file import require_size
from pipeline.geometry.remesh import remesh
from pipeline.geometry.surface_from_points import reconstruct_surface

if TYPE_CHECKING:
    from disco_twin.scene.scene import Scene

MOST_ROUNDING = 0.1  # of a free path

__all__ = ["Medium", "TwinBoundary", "TwinObject", "build_object", "build_scan", "hat_basis", "rounding"]


@dataclass(frozen=True)
class TwinBoundary:
    """Rough (GGX, `alpha`) or smooth dielectric of relative index `eta`; matched: no boundary, eta = 1.

    Smooth is for what is known exactly of energy: its images are black, which no scene may ask for.
    """

    kind: Literal["rough", "smooth", "matched"]
    eta: float
    alpha: float


@dataclass(frozen=True)
class TwinObject:
    """A closed mesh (object frame, mm), its boundary and the medium inside.

    mesh: the outer surface, which is all that scan, silhouettes and the truth of R_d know; inside: bodies in it, each
    after the one around it.
    """

    mesh: trimesh.Trimesh
    boundary: TwinBoundary
    medium: Medium
    inside: tuple[Body, ...] = ()

    def of_lasers(self, lasers: Sequence[int]) -> TwinObject:
        """The object at some of its wavelengths, in this order; one may come more than once."""
        bodies = tuple(body.of_lasers(lasers) for body in self.inside)
        return TwinObject(self.mesh, self.boundary, self.medium.of_lasers(lasers), bodies)

    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Laser indices that share sigma_t and g exactly everywhere, so that one walk serves them."""
        own = [body.medium for body in self.inside if isinstance(body.medium, OwnMedium)]
        found: list[tuple[int, ...]] = []
        for group in self.medium.groups():
            names = {k: tuple((m.sigma_t[k], m.g[k]) for m in own) for k in group}
            found += [tuple(k for k in group if names[k] == name) for name in dict.fromkeys(names.values())]
        return tuple(found)


def build_object(scene: Scene) -> TwinObject:
    """The object of a scene. Raises: InputError for a mesh or a medium that cannot be traced."""
    mesh, surface = _mesh(scene.object.shape), scene.object.boundary
    rough = surface.kind == "rough"
    boundary = TwinBoundary("rough", surface.eta, surface.alpha) if rough else TwinBoundary("matched", 1.0, 0.0)
    wavelengths = [laser.wavelength_nm for laser in scene.rig.lasers]
    outer, shells = mesh, list[Named]()
    if isinstance(scene.object.shape, MeshFile):
        outer, shells = shells_of(mesh, boundary.eta, boundary.alpha, "object.shape.file")
    if shells and not rough:
        raise InputError(
            "the mesh file has shells inside others, whose walls refract light, and the object's own surface does not",
            key="object.boundary.kind", value=surface.kind, allowed="rough",
            remedy="take 'rough', or take the inner shells out of the file",
        )  # fmt: skip
    first = OBJECT + 1 + len(shells)
    named = [*shells, *bodies_of(scene.object.inside, boundary.eta, len(wavelengths), _mesh, first)]
    check_nesting(outer, named)
    medium = build_medium(scene.object.medium, outer, wavelengths)
    obj = TwinObject(outer, boundary, medium, tuple(body for _, body in named))
    require_places(obj)
    return obj


def rounding(obj: TwinObject) -> tuple[float, float, float]:
    """What single precision does to places: a step at the object's farthest coordinate as a share of the shortest free
    path; that coordinate in mm; and the largest sigma_t in 1/mm.
    """
    own = [max(body.medium.sigma_t) for body in obj.inside if isinstance(body.medium, OwnMedium)]
    sigma_t, reach = max(float(obj.medium.sigma_t.max()), *own, 0.0), float(np.abs(obj.mesh.bounds).max())
    return sigma_t * float(np.spacing(np.float32(reach))), reach, sigma_t


def require_places(obj: TwinObject) -> None:
    """Raises: InputError where places are rounded to so much of a free path that light is wrong."""
    share, reach, sigma_t = rounding(obj)
    if share > MOST_ROUNDING:
        raise InputError(
            f"too dense for an object that reaches {reach:.0f} mm from the origin: single precision cannot place light",
            key="object.medium.sigma_t_per_mm", value=round(sigma_t, 3),
            allowed=f"up to {sigma_t * MOST_ROUNDING / share:.2g} there",
            remedy="lower it, or take a smaller object around the origin",
        )  # fmt: skip


def build_scan(scene: Scene, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh that the pipeline is given: `mesh` itself, or one of about `scan.vertices` vertices.

    Raises: InputError where that is no closed mesh, or one of too many vertices.
    """
    vertices, shape = scene.scan.vertices, scene.object.shape
    if vertices is None:
        if len(mesh.vertices) > MOST_VERTICES:
            problem = (
                f"left out, the scan is the object's own mesh of {len(mesh.vertices)} vertices, and R_d holds the "
                "square of that for every laser"
            )
            allowed, remedy = f"at most {MOST_VERTICES}", "set scan.vertices"
            raise InputError(problem, key="scan.vertices", allowed=allowed, remedy=remedy)
        return mesh
    if scene.rig.faults.scanner:
        return reconstruct_surface(*scan_points(mesh, scene.seed), vertices)
    if isinstance(shape, Box):
        return shapes.box(shape, triangles=2 * vertices)  # also of a slab that is thinner than an edge is long
    if isinstance(shape, Extrusion):
        return extrusion(shape, triangles=2 * vertices)
    return remesh(mesh, vertices)


def _mesh(shape: Shape, key: str = "object.shape") -> trimesh.Trimesh:
    """The mesh of a shape. key: the shape's in the scene."""
    match shape:
        case MeshFile():
            return read_mesh(shape.file, f"{key}.file")
        case Pebble():
            mesh = shapes.pebble(shape)
        case Sphere():
            mesh = shapes.sphere(shape)
        case Box():
            mesh = shapes.box(shape)
        case Torus():
            mesh = shapes.torus(shape)
        case Blend():
            mesh = blend(shape)
        case Extrusion():
            mesh = extrusion(shape)
    require_size(mesh, None, key)
    return mesh
