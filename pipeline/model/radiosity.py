"""Terms that answer by the radiosity of a mesh's vertices and by its first moments, both linear on the faces."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from hw.base.arrays import F32, F64
from pipeline.model.term import Term
from pipeline.relight.on_mesh import LightOnMesh, ViewOfMesh


@dataclass(frozen=True)
class RadiosityTerm(Term):
    """Base of terms between vertices: one product for a light serves all views."""

    @property
    @abstractmethod
    def by_direction(self) -> bool:
        """Whether the directions of entry and exit change anything."""

    @abstractmethod
    def radiosity(self, flux: F64, points: F64) -> F64:
        """(1 or 4, L, V) W/mm^2: the radiosity and, by direction, what leaves ahead of it, by component.

        flux: (1 or 4, L, V) W, by direction `LightOnMesh.tilted_flux`, else the flux alone; points: (V, 3) mm
        """

    def radiosities(self, fluxes: Sequence[F64], points: F64) -> list[F64]:
        """`radiosity` of each flux."""
        return [self.radiosity(flux, points) for flux in fluxes]

    def prepare(self, lights: Sequence[LightOnMesh]) -> None:
        """The radiosities by these lights, together."""
        new = [light for light in lights if light not in self._by_light]
        if new:
            points = np.asarray(new[0].mesh.vertices, np.float64)
            fluxes = [light.tilted_flux if self.by_direction else light.flux[None] for light in new]
            self._by_light.update(zip(new, self.radiosities(fluxes, points), strict=True))

    def radiosity_under(self, light: LightOnMesh) -> F64:
        """`radiosity` by a light, worked out once."""
        self.prepare([light])
        return self._by_light[light]

    def image(self, light: LightOnMesh, view: ViewOfMesh) -> F32:
        """Radiosity on the vertices (thesis 5.3: B = E F) and its first moments, linear on the faces."""
        radiosity, *moments = self.radiosity_under(light)
        image = view.image(radiosity)
        for matrix, moment in zip(view.tilted_matrices if moments else (), moments, strict=True):
            flat = np.asarray(matrix @ moment.T)
            image += np.moveaxis(flat.reshape(*image.shape[1:], -1), -1, 0).astype(np.float32)
        return image

    @cached_property
    def _by_light(self) -> WeakKeyDictionary[LightOnMesh, F64]:
        return WeakKeyDictionary()
