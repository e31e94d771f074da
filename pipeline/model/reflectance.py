"""The global term: R_d between the hat functions of the scan's vertices (thesis 2.4, eq. 2.7; 5.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from hw.base.arrays import F32
from pipeline.model.term import Axes, ReflectanceColumns, Term
from pipeline.relight.on_mesh import LightOnMesh, ViewOfMesh

_PAIRS = "laser vertex_in vertex_out"


@dataclass(frozen=True)
class GlobalTerm(Term):
    """reflectance: (L, V_in, V_out) mm^-2, symmetric, mean over both hat functions; measured: (V, V) entries that an
    observed spot near one vertex and the other one support; variance: mm^-4, None where the method states none
    """

    kind: ClassVar[str] = "global"

    reflectance: Annotated[F32, Axes(_PAIRS, "mm^-2")]
    measured: Annotated[NDArray[np.bool_], Axes("vertex_in vertex_out", "1")]
    variance: Annotated[F32 | None, Axes(_PAIRS, "mm^-4")] = None

    def image(self, light: LightOnMesh, view: ViewOfMesh) -> F32:
        """Radiosity on the vertices (thesis 5.3: B = E F), linear on the faces."""
        return view.image(np.stack([q @ r for q, r in zip(light.flux, self.reflectance, strict=True)]))

    def reflectance_columns(self, vertices: Sequence[int] | NDArray[np.int64]) -> ReflectanceColumns:
        """The matrix's rows, which are its columns: R_d is symmetric."""
        variance = None if self.variance is None else self.variance[:, vertices]
        return ReflectanceColumns(self.reflectance[:, vertices], variance, self.measured[vertices])
