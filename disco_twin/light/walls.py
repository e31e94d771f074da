"""Bodies inside the object, as the walk sees them: whose wall was met, what lies on its other side, what fills it.

The walk carries the number of the region that it is in (disco_twin/object/bodies.py): 0 the air around the object, 1
the object, then the bodies. Scenes without bodies have no `Walls`, and nothing of this is in their kernel.

No lobe connects through a wall, and no wall connects to a camera: every such ray is blocked by the outer surface. Light
that has come through a body is connected where it leaves the object, or scatters again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from disco_twin.light.opaque import Opaque
from disco_twin.object.bodies import OBJECT, Body, OwnMedium, Wall


class Walls(Opaque):
    """All arrays but the first are by region.

    region: UInt32 by number of a shape in Mitsuba's registry: what the shape's surface surrounds; around: UInt32, the
    region outside of it; fills: UInt32, CLEAR, GRID or OWN; own: Float, rows of sigma_t, g and an albedo a wavelength.
    """

    region: Any
    around: Any
    fills: Any
    own: Any
    lasers: int


CLEAR, GRID, OWN = 0, 1, 2


def bsdf_of(wall: Wall) -> dict[str, Any]:
    """Mitsuba's description of a wall."""
    if wall.ratio == 1.0:
        return {"type": "null"}
    index = {"int_ior": wall.ratio, "ext_ior": 1.0}
    if wall.alpha == 0.0:
        return {"type": "dielectric", **index}
    return {"type": "roughdielectric", **index, "alpha": wall.alpha, "distribution": "ggx"}


def registered(shape: Any) -> int:
    """A shape's number in Mitsuba's registry, by which a hit tells shapes apart."""
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def walls_of(bodies: Sequence[Body], shapes: Sequence[Any], lasers: Sequence[int]) -> Walls:
    """shapes: the outer surface and then the bodies'; lasers: those of the walk, which share sigma_t and g."""
    numbers = [registered(shape) for shape in shapes]
    region = np.zeros(max(numbers) + 1, np.uint32)
    region[numbers] = OBJECT + np.arange(len(shapes))
    fills, own = [CLEAR, GRID], [[0.0] * (2 + len(lasers))] * (OBJECT + 1)
    for body in bodies:
        medium = body.medium if isinstance(body.medium, OwnMedium) else OwnMedium(*[(0.0,) * (max(lasers) + 1)] * 3)
        scatters = isinstance(body.medium, OwnMedium) and medium.sigma_t[lasers[0]] > 0
        fills.append(OWN if scatters else GRID if body.medium is True else CLEAR)
        own.append([medium.sigma_t[lasers[0]], medium.g[lasers[0]], *(medium.albedo[k] for k in lasers)])
    return Walls(
        region=mi.UInt32(region),
        around=mi.UInt32(np.array([0, 0, *(body.around for body in bodies)], np.uint32)),
        fills=mi.UInt32(np.array(fills, np.uint32)),
        own=mi.Float(np.array(own, np.float32).ravel()),
        lasers=len(lasers),
    )


def region_of(walls: Walls, si: Any) -> Any:
    """The region that the surface at a hit surrounds."""
    return dr.gather(mi.UInt32, walls.region, dr.reinterpret_array(mi.UInt32, si.shape))


def is_outer(walls: Walls | None, si: Any) -> Any:
    """Whether a hit lies on the object's outer surface."""
    return mi.Bool(True) if walls is None else region_of(walls, si) == OBJECT


def scatters(walls: Walls, region: Any) -> Any:
    """Whether a medium fills the region."""
    return dr.gather(mi.UInt32, walls.fills, region) != CLEAR


def rate_in(walls: Walls, region: Any, rate: Any) -> Any:
    """Majorant in a region, where the object's is `rate`."""
    own = dr.gather(mi.UInt32, walls.fills, region) == OWN
    return dr.select(own, dr.gather(mi.Float, walls.own, region * (2 + walls.lasers)), rate)


def medium_in(walls: Walls, region: Any, sigma_t: Any, albedo: Any, g: Any) -> tuple[Any, Any, Any]:
    """sigma_t, albedo and g in a region, where the object's are those given."""
    own = dr.gather(mi.UInt32, walls.fills, region) == OWN
    row = region * (2 + walls.lasers)
    values = [dr.gather(mi.Float, walls.own, row + k) for k in range(2 + walls.lasers)]
    return (
        dr.select(own, values[0], sigma_t),
        dr.select(own, type(albedo)(*values[2:]), albedo),
        dr.select(own, values[1], g),
    )
