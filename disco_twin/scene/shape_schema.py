"""The schema of shapes in a scene: of the object, and of the bodies inside it. Object frame, mm."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from disco_twin.scene.polygons import inside, meeting
from hw.base.config import NearbyFile, Strict
from pipeline.geometry.nominal_rig import Angle, Length, Point, Positive


def _not_zero(vector: Point) -> Point:
    if not any(vector):
        raise ValueError("a direction cannot be zero")
    return vector


Direction = Annotated[Point, AfterValidator(_not_zero)]  # of any length
Size = tuple[Positive, Positive, Positive]
Turn = tuple[Angle, Angle, Angle]
Polygon = Annotated[tuple[tuple[Length, Length], ...], Field(min_length=3, max_length=64)]  # x, y of its corners


class Lean(Strict):
    """Keys in `LEFT_OUT` that a scene does not state are no part of its dump.

    Results are known by the dump: those of scenes that state no such key stay valid although the schema has grown.
    """

    LEFT_OUT: ClassVar[tuple[str, ...]] = ()

    @model_serializer(mode="wrap")
    def _stated(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        found: dict[str, Any] = handler(self)
        return {key: value for key, value in found.items() if key not in self.LEFT_OUT or value not in (None, (), [])}


# ---------------------------------------------------------------- shape
class MeshFile(Strict):
    """A closed, outward oriented triangle mesh in mm (PLY, OBJ or STL), placed with its own coordinates."""

    kind: Literal["mesh"]
    file: NearbyFile


class Pebble(Strict):
    """A smooth stone with bumps and two concave dents, scaled to a bounding box that is centred on the origin."""

    kind: Literal["pebble"]
    size_mm: Size = (40.0, 36.0, 32.0)
    seed: Annotated[int, Field(ge=0)] = 1


class Sphere(Strict):
    """A sphere around the origin."""

    kind: Literal["sphere"]
    radius_mm: Positive = 20.0


class Box(Strict):
    """A box around the origin, or a slab where one side is short."""

    kind: Literal["box"]
    size_mm: Size


class Torus(Strict):
    """A ring around the turntable's axis: not star shaped, and it sees itself."""

    kind: Literal["torus"]
    ring_radius_mm: Positive = 14.0
    tube_radius_mm: Positive = 6.0

    @model_validator(mode="after")
    def _open_ring(self) -> Torus:
        if self.tube_radius_mm >= self.ring_radius_mm:
            raise ValueError("tube_radius_mm must be smaller than ring_radius_mm, the ring would cut itself")
        return self


class Ellipsoid(Strict):
    """A part of a blend. `turn_deg` turns it about its own centre: about x, then y, then z."""

    kind: Literal["ellipsoid"]
    centre_mm: Point = (0.0, 0.0, 0.0)
    radii_mm: Size
    turn_deg: Turn = (0.0, 0.0, 0.0)
    carve: bool = False


class Capsule(Strict):
    """A part of a blend: all balls between two, the radius linear in between (left out: the same at both ends)."""

    kind: Literal["capsule"]
    from_mm: Point
    to_mm: Point
    radius_mm: Positive
    to_radius_mm: Positive | None = None
    carve: bool = False

    @model_validator(mode="after")
    def _two_ends(self) -> Capsule:
        length = math.dist(self.from_mm, self.to_mm)
        if length <= abs(self.radius_mm - (self.to_radius_mm or self.radius_mm)):
            raise ValueError("one end lies inside the other's ball; give an ellipsoid, or move to_mm away from from_mm")
        return self


class Blend(Strict):
    """Ellipsoids and capsules, joined one after the other; one that has `carve` is taken out of what came before it.

    Where surfaces of two parts meet, they run into each other over about `rounding_mm`.
    """

    kind: Literal["blend"]
    parts: Annotated[
        tuple[Annotated[Ellipsoid | Capsule, Field(discriminator="kind")], ...], Field(min_length=1, max_length=64)
    ]
    rounding_mm: Positive = 1.0

    @model_validator(mode="after")
    def _something_to_carve(self) -> Blend:
        if self.parts[0].carve:
            raise ValueError("parts[0] has nothing to carve: begin with a part that is there")
        return self


class Extrusion(Strict):
    """A sharp-edged prism: an outline in x and y less its holes, from z = -height/2 to height/2, then turned.

    Polygons run either way round. `turn_deg` turns about the origin: about x, then y, then z.
    """

    kind: Literal["extrusion"]
    outline_mm: Polygon
    holes_mm: Annotated[tuple[Polygon, ...], Field(max_length=16)] = ()
    height_mm: Positive
    turn_deg: Turn = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _rings(self) -> Extrusion:
        rings = [np.array(ring) for ring in (self.outline_mm, *self.holes_mm)]
        names = ["outline_mm", *(f"holes_mm[{i}]" for i in range(len(self.holes_mm)))]
        found = meeting(rings)
        if found is not None:
            one, other, place = found
            what = f"{names[one]} crosses or touches itself" if one == other else f"{names[one]} meets {names[other]}"
            raise ValueError(f"{what} near {np.round(place, 1).tolist()} mm; draw rings that keep apart")
        for i in range(1, len(rings)):
            around = [k for k in range(len(rings)) if k != i and inside(rings[i][:1], rings[k : k + 1])[0]]
            if around != [0]:
                where = f"inside {names[around[-1]]}" if around and around[-1] else "outside outline_mm"
                raise ValueError(f"{names[i]} lies {where}; draw holes inside the outline and outside each other")
        return self


Shape = Annotated[MeshFile | Pebble | Sphere | Box | Torus | Blend | Extrusion, Field(discriminator="kind")]
