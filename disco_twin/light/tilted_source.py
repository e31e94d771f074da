"""Light over hat functions whose power leans toward directions: what angular moments are the differences of."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from disco_twin.light.sampling import Rng
from disco_twin.light.sources import HatSource, to_float
from hw.base.arrays import F64, I64


class TiltedHatSource(HatSource):
    """Lambertian light as `HatSource` launches it, with three weights: 1, 1 + d . a and 1 + d . b.

    d: the direction of travel's part along the surface; axes: (T, 2, 3) unit, a and b of every tag
    """

    def __init__(self, vertices: F64, faces: I64, hats: F64, axes: F64) -> None:
        super().__init__(vertices, faces, hats, 3)
        self.axes = [to_float(axes[:, k]) for k in (0, 1)]

    def launch(self, rng: Rng, tag: Any, active: Any) -> tuple[Any, Any, Any]:
        position, direction, normal = self.arrive(rng, tag, active)
        along = direction - normal * dr.dot(direction, normal)
        lean = [dr.dot(along, dr.gather(mi.Vector3f, axis, tag, active)) for axis in self.axes]
        return position, direction, self.weight(mi.Float(1.0), 1.0 + lean[0], 1.0 + lean[1])
