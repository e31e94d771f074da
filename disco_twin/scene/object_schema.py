"""The schema of `[object]` and `[scan]` in a scene: boundary, medium, bodies inside; the scan that is handed on.

Object frame, mm, wavelengths in the rig's order.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, field_validator, model_validator

from disco_twin.scene.materials import MATERIALS
from disco_twin.scene.shape_schema import Direction, Lean, Shape
from hw.base.config import NearbyFile, Strict
from pipeline.geometry.nominal_rig import Point, Positive

Share = Annotated[float, Field(ge=0, le=1)]
MOST_SIGMA_T = 1e4  # 1/mm
Coefficient = Annotated[float, Field(ge=0, le=MOST_SIGMA_T)]
PerWavelength = Coefficient | tuple[Coefficient, ...]  # one value for all lasers, or one a laser
MOST_G = 0.999  # beyond, single precision cannot tell a direction from another
MOST_ALBEDO = 1 - 1e-6  # below 1: single precision holds what is absorbed in steps of 6e-8


def _told_apart(albedo: float) -> float:
    if MOST_ALBEDO < albedo < 1:
        raise ValueError(
            f"an albedo so near to 1 cannot be told from others (allowed: 0 to {MOST_ALBEDO:.7g}, and 1); take 1, or "
            f"{MOST_ALBEDO:.7g}"
        )
    return albedo


OneAlbedo = Annotated[Share, AfterValidator(_told_apart)]
Albedo = OneAlbedo | tuple[OneAlbedo, ...]
Asymmetry = Annotated[float, Field(ge=-MOST_G, le=MOST_G)]


# ---------------------------------------------------------------- boundary
LEAST_ETA = 1.001  # Mitsuba takes no rough dielectric of 1
LEAST_ALPHA = 0.02


class BoundaryConfig(Strict):
    """Surface of the object: a dielectric of index `eta`, microfacet roughness `alpha` (GGX), or no boundary at all."""

    kind: Literal["rough", "matched"] = "rough"
    eta: Annotated[float, Field(ge=1, le=3)] = 1.3
    alpha: Annotated[float, Field(ge=LEAST_ALPHA, le=1)] = 0.3

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


# ---------------------------------------------------------------- bodies inside
class Filling(Strict):
    """What fills a body inside the object: one medium everywhere."""

    sigma_t_per_mm: PerWavelength
    albedo: Albedo
    g: Asymmetry | tuple[Asymmetry, ...] = 0.0


class BodyConfig(Lean):
    """A body inside the object, or inside another body, with a wall of its own: a cavity, an inclusion.

    eta: the index of what fills it, 1 of air; alpha: roughness of the wall, 0 for a smooth one. medium: "clear" neither
    scatters nor absorbs, "object" is the object's own. The wall bends light by the index of both sides; where they are
    the same, it only parts the media.
    """

    LEFT_OUT = ("inside",)
    shape: Shape
    centre_mm: Point = (0.0, 0.0, 0.0)
    eta: Annotated[float, Field(ge=1, le=3)] = 1.0
    alpha: Annotated[float, Field(ge=0, le=1)] = 0.0
    medium: Filling | Literal["clear", "object"] = "clear"
    inside: Annotated[tuple[BodyConfig, ...], Field(max_length=16)] = ()

    @field_validator("alpha")
    @classmethod
    def _smooth_or_rough(cls, alpha: float) -> float:
        if 0 < alpha < LEAST_ALPHA:
            raise ValueError(f"a rough wall needs {LEAST_ALPHA} to 1; take 0 for a smooth one")
        return alpha


class ObjectConfig(Lean):
    """The scanned object."""

    LEFT_OUT = ("inside",)
    shape: Shape
    boundary: BoundaryConfig = BoundaryConfig()
    medium: MediumConfig
    inside: Annotated[tuple[BodyConfig, ...], Field(max_length=16)] = ()

    @model_validator(mode="after")
    def _seen_through_a_boundary(self) -> ObjectConfig:
        if self.inside and self.boundary.kind == "matched":
            raise ValueError(
                "no walk connects to a camera through walls inside an object without a boundary; take "
                "boundary.kind = 'rough', or a feature of kind 'hollow'"
            )
        return self

    def per_wavelength(self) -> Iterator[tuple[str, tuple[float, ...]]]:
        """Keys, below `object`, and values of everything that is given once a laser."""
        yield from ((f"medium.{key}", values) for key, values in self.medium.per_wavelength())
        waiting = [(f"inside[{i}]", body) for i, body in enumerate(self.inside)]
        while waiting:
            name, body = waiting.pop(0)
            waiting += [(f"{name}.inside[{i}]", other) for i, other in enumerate(body.inside)]
            if isinstance(body.medium, Filling):
                for key in ("sigma_t_per_mm", "albedo", "g"):
                    values = getattr(body.medium, key)
                    if isinstance(values, tuple):
                        yield f"{name}.medium.{key}", values


# ---------------------------------------------------------------- scan
MOST_VERTICES = 20_000  # R_d holds vertices^2 entries a laser, with their variance: 3.2 GB each at this size


def _storable(vertices: int) -> int:
    if vertices > MOST_VERTICES:
        raise ValueError(f"R_d holds the square of that for every laser, at most {MOST_VERTICES} vertices fit")
    return vertices


class ScanConfig(Strict):
    """The mesh that the pipeline is given: about `vertices` vertices, or (left out) the object's own mesh."""

    vertices: Annotated[int, Field(ge=50), AfterValidator(_storable)] | None = None
