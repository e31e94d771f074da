"""Bodies inside the object: cavities and inclusions with walls of their own, nested as a scene or a mesh file has them.

The space is parted into regions: 0 is the air around the object, 1 the object, k + 2 the k-th body. A body stands after
the one that is around it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from disco_twin.object.media import per_wavelength
from disco_twin.object.mesh import crossing, distance_to
from disco_twin.scene.object_schema import LEAST_ETA, BodyConfig, Filling
from disco_twin.scene.shape_schema import Shape
from hw.base.errors import InputError

OBJECT = 1  # the object's region
THINNEST_MM = 0.01  # between two walls


@dataclass(frozen=True)
class Wall:
    """Smooth (alpha 0) or rough (GGX) between a body and what is around it; ratio: the body's index over the other's,
    1 where nothing is bent.
    """

    ratio: float
    alpha: float

    @classmethod
    def of(cls, eta: float, around: float, alpha: float) -> Wall:
        """Between indices that hardly differ light goes straight on."""
        ratio = eta / around
        return cls(1.0, 0.0) if max(ratio, 1 / ratio) < LEAST_ETA else cls(ratio, alpha)


@dataclass(frozen=True)
class OwnMedium:
    """One medium everywhere: sigma_t in 1/mm, albedo and g, one of each a laser."""

    sigma_t: tuple[float, ...]
    albedo: tuple[float, ...]
    g: tuple[float, ...]

    def of_lasers(self, lasers: Sequence[int]) -> OwnMedium:
        """For some of its wavelengths, in this order."""
        return OwnMedium(*(tuple(values[k] for k in lasers) for values in (self.sigma_t, self.albedo, self.g)))


@dataclass(frozen=True)
class Body:
    """A closed mesh (outward oriented, object frame, mm), the region around it, its wall and what fills it: its own
    medium, the object's (True), or nothing that light meets (None).
    """

    mesh: trimesh.Trimesh
    around: int
    wall: Wall
    medium: OwnMedium | bool | None

    def of_lasers(self, lasers: Sequence[int]) -> Body:
        """For some of the wavelengths, in this order."""
        own = self.medium.of_lasers(lasers) if isinstance(self.medium, OwnMedium) else self.medium
        return Body(self.mesh, self.around, self.wall, own)


Named = tuple[str, Body]  # the scene's key of a body, and the body


def bodies_of(
    inside: Sequence[BodyConfig],
    eta: float,
    lasers: int,
    mesh_of: Callable[[Shape, str], trimesh.Trimesh],
    first: int,
) -> list[Named]:
    """The bodies that a scene states, each after the one around it. eta: the object's index; first: the region of the
    first one; mesh_of: (shape, key) -> mesh.
    """
    found: list[Named] = []
    waiting = [(f"object.inside[{i}]", config, OBJECT, eta) for i, config in enumerate(inside)]
    while waiting:
        key, config, around, index = waiting.pop(0)
        mesh = mesh_of(config.shape, f"{key}.shape").copy()
        mesh.apply_translation(config.centre_mm)
        found.append((key, Body(mesh, around, Wall.of(config.eta, index, config.alpha), _medium(config, lasers))))
        region = first + len(found) - 1
        waiting += [(f"{key}.inside[{i}]", other, region, config.eta) for i, other in enumerate(config.inside)]
    return found


def _medium(config: BodyConfig, lasers: int) -> OwnMedium | bool | None:
    if not isinstance(config.medium, Filling):
        return True if config.medium == "object" else None
    values = config.medium.sigma_t_per_mm, config.medium.albedo, config.medium.g
    return OwnMedium(*(tuple(float(x) for x in per_wavelength(v, lasers)) for v in values))


def shells_of(mesh: trimesh.Trimesh, eta: float, alpha: float, key: str) -> tuple[trimesh.Trimesh, list[Named]]:
    """A mesh file's outermost shells, and those inside them: in turn cavities full of air and parts of the object."""
    parts = list(mesh.split(only_watertight=False))
    around = [[k for k, other in enumerate(parts) if other is not part and _holds(other, part)] for part in parts]
    if not any(around):
        return mesh, []
    order = sorted((k for k in range(len(parts)) if around[k]), key=lambda k: len(around[k]))
    region = {k: OBJECT + 1 + i for i, k in enumerate(order)}
    found = []
    for k in order:
        nearest = max(around[k], key=lambda other: len(around[other]))
        cavity = len(around[k]) % 2 == 1
        shell = parts[k].copy()
        if cavity:
            shell.invert()
        wall = Wall.of(1.0 if cavity else eta, eta if cavity else 1.0, alpha)
        found.append((key, Body(shell, region.get(nearest, OBJECT), wall, None if cavity else True)))
    outer = [part for part, others in zip(parts, around, strict=True) if not others]
    return trimesh.util.concatenate(outer), found


def _holds(outer: trimesh.Trimesh, inner: trimesh.Trimesh) -> bool:
    return bool((outer.bounds[0] < inner.bounds[0]).all() and outer.contains(inner.vertices[:1])[0])


def check_nesting(outer: trimesh.Trimesh, named: Sequence[Named]) -> None:
    """Every body lies in the region around it, apart from all other walls.

    Raises: InputError with the key of the body that does not.
    """
    bodies = [body for _, body in named]
    for number, (key, body) in enumerate(named):
        shell = outer if body.around == OBJECT else bodies[body.around - OBJECT - 1].mesh
        _require_apart(body.mesh, shell, key, "the wall around it", inside=True)
        for other in bodies[:number]:
            if other.around == body.around:
                _require_apart(body.mesh, other.mesh, key, "the wall of another body", inside=False)


def _require_apart(mesh: trimesh.Trimesh, other: trimesh.Trimesh, key: str, what: str, inside: bool) -> None:
    remedy = "move it or make it smaller"
    place = crossing(trimesh.util.concatenate([mesh, other]))
    if place is not None:
        raise InputError(f"crosses {what} near {np.round(place, 1).tolist()} mm", key=key, remedy=remedy)
    within, around = other.contains(mesh.vertices), mesh.contains(other.vertices)
    if inside and not within.all():
        raise InputError("does not lie in what it is stated to be inside", key=key, remedy=remedy)
    if not inside and (within.any() or around.any()):
        raise InputError(f"lies beyond {what}", key=key, remedy="state one as `inside` of the other")
    ways = distance_to(other, np.asarray(mesh.vertices)), distance_to(mesh, np.asarray(other.vertices))
    gap = float(min(way.min() for way in ways))
    if gap < THINNEST_MM:
        allowed = f"at least {THINNEST_MM} mm apart"
        raise InputError(f"comes as near as {gap:.2g} mm to {what}", key=key, allowed=allowed, remedy=remedy)
