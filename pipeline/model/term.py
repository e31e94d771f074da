"""What a model is a sum of: a term answers for the radiance that it adds under a light in a view.

A term declares its arrays, their axes and units in its annotations. The file, its checks and the choice of lasers
follow from them, so a new kind of term is one file here and one entry in `relightable.KINDS`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, get_type_hints

import numpy as np
from numpy.typing import NDArray

from hw.base.arrays import F32, F64, I64, Bool
from pipeline.relight.on_mesh import LightOnMesh, ViewOfMesh


class Axes:
    """An array's axes, in order, its unit, and NumPy's letter for its kind of numbers. Axes of one stem (`vertex_in`,
    `vertex_out`) have one length.
    """

    def __init__(self, names: str, unit: str, kind: str = "f") -> None:
        self.names, self.unit, self.kind = tuple(names.split()), unit, kind


@dataclass(frozen=True)
class ReflectanceColumns:
    """R_d from n vertices to all V, or exitance per irradiance. mean: (L, n, V) mm^-2; variance: the same shape, mm^-4,
    or None where a method states none; measured: (n, V) entries that samples support
    """

    mean: NDArray[np.floating]
    variance: NDArray[np.floating] | None
    measured: Bool


@dataclass(frozen=True)
class Term(ABC):
    """Base of all terms: frozen dataclasses whose fields are arrays, annotated with their `Axes`."""

    kind: ClassVar[str]  # in files

    @abstractmethod
    def image(self, light: LightOnMesh, view: ViewOfMesh) -> F32:
        """(L, H, W) radiance in W/(mm^2 sr) that the term adds, averaged over each pixel."""

    def prepare(self, lights: Sequence[LightOnMesh]) -> None:  # noqa: B027 - most have nothing to prepare
        """Work out for several lights at once what their images need, where that is quicker than one by one."""

    def image_variance(self, light: LightOnMesh, view: ViewOfMesh) -> F32 | None:
        """(2, L, H, W) variance of `image` by that of the term's entries, as if their errors were independent, and as
        if they were all alike; None where the term states none.
        """
        return None

    def reflectance_columns(self, vertices: Sequence[int] | I64) -> ReflectanceColumns | None:
        """The term's part of R_d from these vertices to all; None where it states none between different points."""
        return None

    def throughput(self, vertices: Sequence[int] | I64, area: F64) -> F64 | None:
        """(L, n, V) share of the flux transmitted at these vertices that comes up again around every vertex, F of the
        thesis (2.4); None where the term does not state it. area: (V,) mm^2 of the hat functions.
        """
        columns = self.reflectance_columns(vertices)
        return None if columns is None else np.asarray(columns.mean * area, np.float64)

    @property
    def lasers(self) -> int:
        """Number of wavelengths. Raises: ValueError where the array that tells it has no such axis."""
        name, axes = next((name, a.names) for name, a in self.axes().items() if "laser" in a.names)
        shape, at = getattr(self, name).shape, axes.index("laser")
        if at >= len(shape):
            raise ValueError(f"{self.kind}.{name}: has no axis of lasers")
        return int(shape[at])

    @classmethod
    def axes(cls) -> dict[str, Axes]:
        """By name of the array."""
        hints = get_type_hints(cls, include_extras=True)
        return {name: a for name, hint in hints.items() for a in getattr(hint, "__metadata__", ()) if type(a) is Axes}

    def arrays(self) -> dict[str, NDArray[Any]]:
        """By name; an optional array that is not there is left out."""
        return {name: array for name in self.axes() if (array := getattr(self, name)) is not None}

    def of_lasers(self, lasers: Sequence[int]) -> Self:
        """The term with these lasers' parts, in this order; a laser may stand in it more than once."""
        axes = {name: self.axes()[name].names for name in self.arrays()}
        taken = {n: getattr(self, n).take(lasers, axes[n].index("laser")) for n in axes if "laser" in axes[n]}
        return replace(self, **taken)

    def check(self, lasers: int, vertices: int) -> None:
        """Raises: ValueError for arrays that do not fit these or each other, are of another kind, or not finite."""
        known = {"laser": lasers, "vertex": vertices}
        for name, array in self.arrays().items():
            stems = [axis.split("_")[0] for axis in self.axes()[name].names]
            if array.ndim != len(stems) or any(
                known.setdefault(s, n) != n for s, n in zip(stems, array.shape, strict=True)
            ):
                expected = ", ".join(f"{s} {known[s]}" if s in known else s for s in stems)
                raise ValueError(f"{self.kind}.{name}: has the shape {array.shape}, not ({expected})")
            if array.dtype.kind != self.axes()[name].kind:
                raise ValueError(f"{self.kind}.{name}: holds {array.dtype}, not kind {self.axes()[name].kind!r}")
            if not np.isfinite(array).all():
                raise ValueError(f"{self.kind}.{name}: holds values that are not finite")
