"""The global term: R_d between the hat functions of the scan's vertices (thesis 2.4, eq. 2.7; 5.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar
from weakref import WeakKeyDictionary

import numpy as np
from scipy.spatial.distance import cdist

from hw.base.arrays import F32, F64, I64, Bool
from pipeline.model.radiosity import RadiosityTerm
from pipeline.model.term import Axes, ReflectanceColumns
from pipeline.model.tilt import TiltLaw, gathered, placed, tilt_kernel
from pipeline.relight.on_mesh import LightOnMesh, ViewOfMesh

_PAIRS = "laser vertex_in vertex_out"
_ROWS = 512


@dataclass(frozen=True)
class GlobalTerm(RadiosityTerm):
    """reflectance: (L, V_in, V_out) mm^-2, symmetric, mean over both hat functions; measured: (V, V) entries that an
    observed spot near one vertex and the other one support; variance: mm^-4, None where the method states none;
    tilt: slopes of the `TiltLaw`s at tilt_distance, None where directions are not known to change anything;
    tilt_variance: of the slopes, None where the method states none
    """

    kind: ClassVar[str] = "global"

    reflectance: Annotated[F32, Axes(_PAIRS, "mm^-2")]
    measured: Annotated[Bool, Axes("vertex_in vertex_out", "1", kind="b")]
    variance: Annotated[F32 | None, Axes(_PAIRS, "mm^-4")] = None
    tilt: Annotated[F64 | None, Axes("laser distance", "1")] = None
    tilt_distance: Annotated[F64 | None, Axes("distance", "mm")] = None
    tilt_variance: Annotated[F64 | None, Axes("laser distance", "1")] = None

    @property
    def by_direction(self) -> bool:
        """Whether there are slopes."""
        return self.tilt is not None

    def radiosity(self, flux: F64, points: F64) -> F64:
        """The radiosity, and what leaves ahead of it: sums of q R_d s e, by component."""
        return self.radiosities([flux], points)[0]

    def radiosities(self, fluxes: Sequence[F64], points: F64) -> list[F64]:
        """The factor of either end is kept to first order, their product is left out. Some rows at a time, for all
        fluxes: no matrix is kept beside R_d, and the kernel takes longer than its products.
        """
        if self.tilt is None or self.tilt_distance is None:
            return [np.stack([q @ r for q, r in zip(f[0], self.reflectance, strict=True)])[None] for f in fluxes]
        out = [np.zeros((4, *flux.shape[1:])) for flux in fluxes]
        for first in range(0, len(points), _ROWS):
            rows = slice(first, first + _ROWS)
            distance = cdist(points[rows], points)
            for laser, slopes in enumerate(self.tilt):
                reflectance = self.reflectance[laser, rows].astype(np.float64)
                kernel = tilt_kernel(reflectance, distance, TiltLaw(self.tilt_distance, slopes))
                for own, flux in zip(out, fluxes, strict=True):
                    own[0, laser] += flux[0, laser, rows] @ reflectance
                    own[:, laser] += gathered(placed(flux[:, laser, rows], points[rows]) @ kernel, points)
        return out

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

    def check(self, lasers: int, vertices: int) -> None:
        """Raises: ValueError as every term, for a matrix that is not symmetric to float32's rounding, a variance
        below 0, and a tilt's slopes without distances in order.
        """
        super().check(lasers, vertices)
        distance = self.tilt_distance
        if (self.tilt is None) != (distance is None):
            raise ValueError(f"{self.kind}.tilt: slopes and their distances come together")
        if self.tilt is None and self.tilt_variance is not None:
            raise ValueError(f"{self.kind}.tilt_variance: is of slopes that are not there")
        if distance is not None and not (np.diff(distance, prepend=0.0) > 0).all():
            raise ValueError(f"{self.kind}.tilt_distance: is not above 0 and ascending")
        for name, array in self.arrays().items():
            if "vertex_out" not in self.axes()[name].names:
                continue
            other = array.swapaxes(-1, -2)
            if name == "variance" and array.min(initial=0.0) < 0:
                raise ValueError(f"{self.kind}.{name}: holds values below 0")
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
