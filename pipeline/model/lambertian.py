"""An opaque surface: light leaves where it enters. It states no R_d between different points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from hw.base.arrays import F32, F64, I64
from pipeline.geometry.mesh import RayMesh
from pipeline.model.term import Axes, Term
from pipeline.relight.on_mesh import LightOnMesh, ViewOfMesh


@dataclass(frozen=True)
class LambertianTerm(Term):
    """albedo: (L, V) share of the transmitted flux at a vertex that leaves there again."""

    kind: ClassVar[str] = "lambertian"

    albedo: Annotated[F32, Axes("laser vertex", "1")]

    def check(self, lasers: int, vertices: int) -> None:
        """Raises: ValueError as every term, and for an albedo below 0."""
        super().check(lasers, vertices)
        if self.albedo.min(initial=0.0) < 0:
            raise ValueError(f"{self.kind}.albedo: holds values below 0")

    def image(self, light: LightOnMesh, view: ViewOfMesh) -> F32:
        """Radiosity albedo * flux / area, linear on the faces."""
        return view.image(light.flux * self.albedo / RayMesh.of(light.mesh).vertex_areas)

    def throughput(self, vertices: Sequence[int] | I64, area: F64) -> F64:
        """The albedo, all of it where the light entered."""
        out = np.zeros((self.lasers, len(vertices), len(area)))
        out[:, np.arange(len(vertices)), vertices] = self.albedo[:, vertices]
        return out
