"""An opaque surface: light leaves where it enters. It states no R_d between different points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from hw.base.arrays import F32
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
