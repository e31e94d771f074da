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

    def image(self, light: LightOnMesh, view: ViewOfMesh) -> F32:
        """Radiosity albedo * flux / area, linear on the faces."""
        return view.image(light.flux * self.albedo / RayMesh.of(light.mesh).vertex_areas)

    def throughput(self, vertices: Sequence[int] | I64, area: F64) -> F64:
        """The albedo, all of it where the light entered."""
        out = np.zeros((self.lasers, len(vertices), len(area)))
        out[:, np.arange(len(vertices)), vertices] = self.albedo[:, vertices]
        return out
