"""The schema of `[object]` and `[scan]` in a scene: shape, boundary, medium; the mesh that the pipeline is given.

Object frame, mm, wavelengths in the rig's order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from disco_twin.scene.materials import MATERIALS
from disco_twin.scene.polygons import inside, meeting
from hw.base.config import NearbyFile, Strict
from pipeline.geometry.nominal_rig import Angle, Length, Point, Positive


def _not_zero(vector: Point) -> Point:
    if not any(vector):
        raise ValueError("a direction cannot be zero")
    return vector


Share = Annotated[float, Field(ge=0, le=1)]
Coefficient = Annotated[float, Field(ge=0, le=1e4)]
PerWavelength = Coefficient | tuple[Coefficient, ...]  # one value for all lasers, or one a laser
Albedo = Share | tuple[Share, ...]
Asymmetry = Annotated[float, Field(gt=-1, lt=1)]
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


# ---------------------------------------------------------------- boundary
LEAST_ETA = 1.001  # Mitsuba takes no rough dielectric of 1


class BoundaryConfig(Strict):
    """Surface of the object: a dielectric of index `eta`, microfacet roughness `alpha` (GGX), or no boundary at all."""

    kind: Literal["rough", "matched"] = "rough"
    eta: Annotated[float, Field(ge=1, le=3)] = 1.3
    alpha: Annotated[float, Field(ge=0.02, le=1)] = 0.3

    @field_validator("kind", mode="before")
    @classmethod
    def _seen_by_a_camera(cls, kind: object) -> object:
        if kind == "smooth":
            raise ValueError("no walk connects to a camera through a smooth boundary; take 'rough' with alpha = 0.02")
        return kind

    @model_validator(mode="after")
    def _refracts(self) -> BoundaryConfig:
        if self.kind == "rough" and self.eta < LEAST_ETA:
            raise ValueError(
                f"eta = {self.eta:g} bends no light, which a rough boundary has to (allowed: {LEAST_ETA:g} to 3); take "
                "kind = 'matched' for an object without a boundary"
            )
        return self


# ---------------------------------------------------------------- medium: what fills the object before features
class Homogeneous(Strict):
    """The same everywhere."""

    kind: Literal["homogeneous"]
    sigma_t_per_mm: PerWavelength
    albedo: Albedo


class Material(Strict):
    """A measured material by name, as sigma_s' and sigma_a: it is meant with g = 0."""

    kind: Literal["material"]
    name: str

    @model_validator(mode="after")
    def _known(self) -> Material:
        if self.name not in MATERIALS:
            raise ValueError(f"unknown material {self.name!r}, choose one of {', '.join(MATERIALS)}")
        return self


class Grid(Lean):
    """Voxels from files: `.npy` (nz, ny, nx) or (lasers, nz, ny, nx), or Mitsuba's `.vol`.

    The corners are those of the outermost cells. A `.vol` file brings its own corners unless they are given here.
    `g_file` holds an asymmetry for each voxel, in place of the medium's `g`.
    """

    LEFT_OUT = ("g_file",)
    kind: Literal["grid"]
    sigma_t_file: NearbyFile  # 1/mm
    albedo_file: NearbyFile | None = None
    albedo: Albedo | None = None
    g_file: NearbyFile | None = None
    low_mm: Point | None = None
    high_mm: Point | None = None

    @model_validator(mode="after")
    def _one_albedo(self) -> Grid:
        if (self.albedo is None) == (self.albedo_file is None):
            raise ValueError("give exactly one of albedo and albedo_file")
        if (self.low_mm is None) != (self.high_mm is None):
            raise ValueError("give both low_mm and high_mm, or neither")
        return self


Base = Annotated[Homogeneous | Material | Grid, Field(discriminator="kind")]


# ---------------------------------------------------------------- medium: features laid over the base, in order
class Scattering(Lean):
    """What a feature is made of. `g` left out is the medium's."""

    LEFT_OUT = ("g",)
    sigma_t_per_mm: PerWavelength
    albedo: Albedo
    g: Asymmetry | tuple[Asymmetry, ...] | None = None


class Veins(Scattering):
    """Thin wavy sheets, like the veins of marble: a foam of cells `spacing_mm` wide with walls `width_mm` thick."""

    kind: Literal["veins"]
    spacing_mm: Positive = 12.0
    width_mm: Positive = 1.5
    seed: Annotated[int, Field(ge=0)] = 1


class Crack(Scattering):
    """A disc-shaped, slightly wavy sheet. With `sigma_t_per_mm = 0` it is a gap (of the object's own index)."""

    kind: Literal["crack"]
    albedo: Albedo = 0.0
    through_mm: Point = (0.0, 0.0, 0.0)
    normal: Direction = (1.0, 0.0, 0.0)
    radius_mm: Positive = 10.0
    width_mm: Positive = 0.6
    waviness_mm: Annotated[float, Field(ge=0)] = 0.5


class Layers(Scattering):
    """Parallel layers: within each period along `direction`, the first `share` is this material."""

    kind: Literal["layers"]
    direction: Direction = (0.0, 0.0, 1.0)
    period_mm: Positive
    share: Annotated[float, Field(gt=0, lt=1)] = 0.5
    offset_mm: float = 0.0


class HollowCore(Strict):
    """An empty ball: light crosses it unchanged (its index is the object's own, it has no surface)."""

    kind: Literal["hollow"]
    centre_mm: Point = (0.0, 0.0, 0.0)
    radius_mm: Positive


class Patch(Scattering):
    """Opaque paint: the part of a ball around a surface point that lies less than `depth_mm` below the surface."""

    kind: Literal["patch"]
    sigma_t_per_mm: PerWavelength = 10.0
    albedo: Albedo = 0.2
    centre_mm: Point  # the surface point nearest to it is painted
    radius_mm: Positive = 5.0
    depth_mm: Positive = 1.0


Feature = Annotated[Veins | Crack | Layers | HollowCore | Patch, Field(discriminator="kind")]


class MediumConfig(Strict):
    """`base` with `features` laid over it in order. `g` is the base's.

    `cell_mm` is the edge of the voxels that features are sampled on; a grid base keeps its own voxels.
    """

    base: Base
    features: Annotated[tuple[Feature, ...], Field(max_length=32)] = ()
    g: Asymmetry | tuple[Asymmetry, ...] = 0.0
    cell_mm: Annotated[float, Field(ge=0.02, le=10)] = 0.5

    @model_validator(mode="after")
    def _reduced(self) -> MediumConfig:
        if isinstance(self.base, Material) and np.any(self.g):
            raise ValueError("a measured material states reduced scattering, it needs g = 0")
        if isinstance(self.base, Grid) and self.base.g_file is not None and "g" in self.model_fields_set:
            raise ValueError("give either g or base.g_file")
        return self

    def per_wavelength(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        """Keys and values of everything that is given once a laser."""
        parts: list[tuple[str, Strict]] = [("", self), ("base.", self.base)]
        parts += [(f"features[{i}].", feature) for i, feature in enumerate(self.features)]
        for prefix, part in parts:
            for name in ("sigma_t_per_mm", "albedo", "g"):
                value = getattr(part, name, None)
                if isinstance(value, tuple):
                    yield prefix + name, value


class ObjectConfig(Strict):
    """The scanned object."""

    shape: Shape
    boundary: BoundaryConfig = BoundaryConfig()
    medium: MediumConfig


# ---------------------------------------------------------------- scan
MOST_VERTICES = 20_000  # R_d holds vertices^2 entries a laser, with their variance: 3.2 GB each at this size


def _storable(vertices: int) -> int:
    if vertices > MOST_VERTICES:
        raise ValueError(f"R_d holds the square of that for every laser, at most {MOST_VERTICES} vertices fit")
    return vertices


class ScanConfig(Strict):
    """The mesh that the pipeline is given: about `vertices` vertices, or (left out) the object's own mesh."""

    vertices: Annotated[int, Field(ge=50), AfterValidator(_storable)] | None = None
