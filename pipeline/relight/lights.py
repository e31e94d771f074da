"""Lights, as one file format for the pipeline's irradiance and the twin's references. Object frame, mm, W.

The pipeline asks a light for the radiation that arrives at a surface point; the twin launches photons from it.
Colours are factors per laser wavelength.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from pipeline.config import Strict
from pipeline.rig import Point, Positive

Colour = tuple[float, ...]


class Uniform(Strict):
    """Constant radiance from everywhere, W/(mm^2 sr)."""

    kind: Literal["uniform"] = "uniform"
    name: str = "uniform"
    radiance: Positive = 1.0
    colour: Colour = (1.0, 1.0, 1.0)


class Directional(Strict):
    """Parallel light travelling along `direction`; `irradiance` in W/mm^2 on a plane across it.

    With `edge_side`, a half plane is dark: points p with dot(p, edge_side) < edge_offset_mm see no light
    (`edge_side` is made perpendicular to `direction`).
    """

    kind: Literal["directional"] = "directional"
    name: str = "directional"
    direction: Point
    irradiance: Positive = 1.0
    colour: Colour = (1.0, 1.0, 1.0)
    edge_side: Point | None = None
    edge_offset_mm: float = 0.0


class Beam(Strict):
    """A collimated round beam of uniform profile, axis through `through_mm` along `direction`, power in W."""

    kind: Literal["beam"] = "beam"
    name: str
    direction: Point
    through_mm: Point = (0.0, 0.0, 0.0)
    diameter_mm: Positive
    power_w: Positive = 1.0
    colour: Colour = (1.0, 1.0, 1.0)


class TexturedProjector(Strict):
    """A pinhole projector; intensity W/sr on the axis, falling with the cube of the cosine like a flat slide.

    Slide coordinates (a, b) are millimetres in the plane through `aim_mm` across the axis. The slide's transmission is
    (1 + contrast * sin(2 pi a / period) * sin(2 pi b / period)) / (1 + contrast) inside the square |a|, |b| <= half_width.
    """

    kind: Literal["projector"] = "projector"
    name: str = "projector"
    position_mm: Point
    aim_mm: Point = (0.0, 0.0, 0.0)
    up: Point = (0.0, 0.0, 1.0)
    period_mm: Positive = 8.0
    contrast: Annotated[float, Field(ge=0, le=1)] = 1.0
    half_width_mm: Positive = 40.0
    intensity: Positive = 1.0
    colour: Colour = (1.0, 1.0, 1.0)


class Lobe(Strict):
    """One von Mises-Fisher lobe of an environment: radiance = peak * exp(sharpness (cos - 1)) towards `direction`."""

    direction: Point  # towards the light
    sharpness: Annotated[float, Field(gt=0, le=1e4)]
    radiance: Colour


class Environment(Strict):
    """Distant radiance: a constant plus lobes, W/(mm^2 sr) per wavelength."""

    kind: Literal["environment"] = "environment"
    name: str = "environment"
    constant: Colour = (0.0, 0.0, 0.0)
    lobes: Annotated[tuple[Lobe, ...], Field(max_length=64)] = ()


Light = Annotated[Uniform | Directional | Beam | TexturedProjector | Environment, Field(discriminator="kind")]
