"""The global term: R_d between the hat functions of the scan's vertices (thesis 2.4, eq. 2.7; 5.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar
from weakref import WeakKeyDictionary

import numpy as np

from hw.base.arrays import F32, F64, I64, Bool
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
    measured: Annotated[Bool, Axes("vertex_in vertex_out", "1", kind="b")]
    variance: Annotated[F32 | None, Axes(_PAIRS, "mm^-4")] = None

    def image(self, light: LightOnMesh, view: ViewOfMesh) -> F32:
        """Radiosity on the vertices (thesis 5.3: B = E F), linear on the faces."""
        if light not in self._radiosity:
            self._radiosity[light] = np.stack([q @ r for q, r in zip(light.flux, self.reflectance, strict=True)])
        return view.image(self._radiosity[light])

    def image_variance(self, light: LightOnMesh, view: ViewOfMesh) -> F32 | None:
        """Independent errors add up in squares from entry to vertex to pixel; errors that are alike simply add up."""
        if self.variance is None:
            return None
        if light not in self._spread:
            pairs = list(zip(light.flux, self.variance, strict=True))
            independent = np.stack([q**2 @ v for q, v in pairs])
            self._spread[light] = independent, np.stack([_deviation(np.abs(q), v) for q, v in pairs])
        independent, alike = self._spread[light]
        return np.stack([view.image(independent, squared=True), view.image(alike) ** 2])

    @cached_property
    def _spread(self) -> WeakKeyDictionary[LightOnMesh, tuple[F64, F64]]:
        """(L, V) by light: variance of the radiosity for independent errors, deviation for errors that are alike."""
        return WeakKeyDictionary()

    @cached_property
    def _radiosity(self) -> WeakKeyDictionary[LightOnMesh, F64]:
        """(L, V) W/mm^2 by light: the product costs more than the image, and serves all views."""
        return WeakKeyDictionary()

    def check(self, lasers: int, vertices: int) -> None:
        """Raises: ValueError as every term, and for a matrix that is not symmetric to float32's rounding."""
        super().check(lasers, vertices)
        for name, array in self.arrays().items():
            other = array.swapaxes(-1, -2)
            if not np.array_equal(array, other) and not np.allclose(array, other, 1e-4, 1e-6 * float(array.max())):
                raise ValueError(f"{self.kind}.{name}: is not symmetric")

    def reflectance_columns(self, vertices: Sequence[int] | I64) -> ReflectanceColumns:
        """The matrix's rows, which are its columns: R_d is symmetric."""
        variance = None if self.variance is None else self.variance[:, vertices]
        return ReflectanceColumns(self.reflectance[:, vertices], variance, self.measured[vertices])


def _deviation(flux: F64, variance: F32) -> F64:
    """(V,) sum of flux times the entries' deviations, some rows at a time: no second matrix of that size."""
    rows = range(0, len(flux), 1024)
    return np.asarray(sum(flux[u : u + 1024] @ np.sqrt(variance[u : u + 1024]) for u in rows), np.float64)
