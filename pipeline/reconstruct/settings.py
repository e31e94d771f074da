"""Settings of the reconstruction: the schema of `[reconstruct]` in a scene."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from hw.base.config import Strict
from pipeline.reconstruct.registry import known_methods


def _known(name: str) -> str:
    if name not in known_methods():
        raise PydanticCustomError("literal_error", "no such method")
    return name


MethodName = Annotated[
    str, AfterValidator(_known), Field(json_schema_extra=lambda schema: schema.update(enum=list(known_methods())))
]
Degrees = Annotated[float, Field(gt=0, lt=90)]


class ReconstructConfig(Strict):
    """What the pipeline assumes and which data it trusts.

    eta: refractive index that is assumed; the scene's own stays with the twin
    max_incidence_deg: spots that the laser meets more obliquely are left out
    max_view_deg: surface that a camera sees more obliquely is left out
    highlight_deg: a spot's surroundings are not read by a camera within this angle of its mirror direction (measured
        between half vector and normal); 0 reads everything, right where no light is reflected at the surface
    """

    eta: Annotated[float, Field(ge=1, le=3)] = 1.3
    max_incidence_deg: Degrees = 65.0
    max_view_deg: Degrees = 75.0
    highlight_deg: Annotated[float, Field(ge=0, lt=90)] = 10.0
    methods: Annotated[tuple[MethodName, ...], Field(min_length=1)] = ("default", "disco2004", "dipole", "lambertian")
