"""Lights, as one file format for the pipeline's irradiance and the twin's references. Object frame, mm, W.

The pipeline works out what arrives from a light at a surface point; the twin launches photons from it.
Colours are factors per laser wavelength.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from hw.base.config import Strict
from pipeline.geometry.nominal_rig import Aimed, Point, Positive


def _not_zero(vector: Point) -> Point:
    if math.hypot(*vector) < 1e-9:
        raise ValueError("a direction must not be the zero vector")
    return vector


Direction = Annotated[Point, AfterValidator(_not_zero)]  # of any length
Colour = tuple[Annotated[float, Field(ge=0)], ...]


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
    direction: Direction
    irradiance: Positive = 1.0
    colour: Colour = (1.0, 1.0, 1.0)
    edge_side: Direction | None = None
    edge_offset_mm: float = 0.0


class Beam(Strict):
    """A collimated round beam of uniform profile, axis through `through_mm` along `direction`, power in W."""

    kind: Literal["beam"] = "beam"
    name: str
    direction: Direction
    through_mm: Point = (0.0, 0.0, 0.0)
    diameter_mm: Positive
    power_w: Positive = 1.0
    colour: Colour = (1.0, 1.0, 1.0)


class TexturedProjector(Aimed):
    """A pinhole projector; intensity W/sr on the axis, falling with the cube of the cosine like a flat slide.

    Slide coordinates (a, b) are millimetres in the plane through `aim_mm` across the axis, a to the right and b down
    as seen from the projector. The slide's transmission is (1 + contrast * sin(2 pi a / period) * sin(2 pi b / period))
    / (1 + contrast) inside the square |a|, |b| <= half_width and 0 outside.
    """

    kind: Literal["projector"] = "projector"
    name: str = "projector"
    period_mm: Positive = 8.0
    contrast: Annotated[float, Field(ge=0, le=1)] = 1.0
    half_width_mm: Positive = 40.0
    intensity: Positive = 1.0
    colour: Colour = (1.0, 1.0, 1.0)


class Lobe(Strict):
    """One von Mises-Fisher lobe of an environment: radiance = peak * exp(sharpness (cos - 1)) towards `direction`."""

    direction: Direction  # towards the light
    sharpness: Annotated[float, Field(gt=0, le=1e4)]
    radiance: Colour


class Environment(Strict):
    """Distant radiance: a constant plus lobes, W/(mm^2 sr) per wavelength."""

    kind: Literal["environment"] = "environment"
    name: str = "environment"
    constant: Colour = (0.0, 0.0, 0.0)
    lobes: Annotated[tuple[Lobe, ...], Field(max_length=64)] = ()


Light = Annotated[Uniform | Directional | Beam | TexturedProjector | Environment, Field(discriminator="kind")]


def shipped_lights(camera_mm: Point) -> tuple[Light, ...]:
    """The seven lights of the scores, for an object of about 40 mm at the origin.

    camera_mm: position of the first held-out camera, object frame; the lights stand around the object relative to it.
    `behind` is 125 degrees away from it, the farthest that a reference reaches at a sensible cost.
    """
    ahead = np.array(camera_mm) / math.hypot(*camera_mm)
    left = np.cross([0.0, 0.0, 1.0], ahead) if abs(ahead[2]) < 0.99 else np.array([0.0, 1.0, 0.0])
    left /= np.linalg.norm(left)

    def towards(angle_deg: float, rise: float = 0.0) -> Point:
        """A direction `angle_deg` from the camera's, counter-clockwise from above, then raised."""
        angle = math.radians(angle_deg)
        x, y, z = math.cos(angle) * ahead + math.sin(angle) * left
        return round(float(x), 6), round(float(y), 6), round(float(z) + rise, 6)

    def travel(angle_deg: float, rise: float = 0.0) -> Point:
        x, y, z = towards(angle_deg, rise)
        return -x, -y, -z

    x, y, z = towards(-70, 0.3)
    lobes = (
        Lobe(direction=towards(40, 0.8), sharpness=20.0, radiance=(6.0, 5.0, 4.0)),
        Lobe(direction=towards(-100, 0.2), sharpness=4.0, radiance=(0.6, 0.9, 1.4)),
    )
    return (
        Uniform(),
        Directional(direction=travel(75, 0.5)),
        Directional(name="edge", direction=travel(75, 0.5), edge_side=(0.1, 0.2, 1.0)),
        Beam(name="behind", direction=travel(125), diameter_mm=8.0),
        TexturedProjector(position_mm=(500 * x, 500 * y, 500 * z), intensity=2.5e5),
        Beam(name="spot", direction=travel(-65, 0.2), diameter_mm=5.0),
        Environment(constant=(0.15, 0.2, 0.3), lobes=lobes),
    )
