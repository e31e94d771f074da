"""Settings of the reconstruction: the schema of `[reconstruct]` in a scene."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from pipeline.config import Strict


class ReconstructConfig(Strict):
    """`eta` is the refractive index that the pipeline assumes; it is never told the scene's."""

    eta: Annotated[float, Field(ge=1, le=3)] = 1.3
