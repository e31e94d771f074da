"""Relighting at interactive rates: R_d as a sparse near part and a far part of low rank, with a bound of the error.

Between near vertices R_d is steep, but there are few of them: their entries are exact. Between the others it is smooth:
a sum of products of few functions. A light then costs O(V (near + rank)) in place of O(V^2). Angular moments go the
same way, by a kernel of their own (`pipeline.model.tilt.tilt_kernel`). `pipeline.model.factorise` makes such terms.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar

import numpy as np
from scipy import sparse

from hw.base.arrays import F32, F64, I64
from pipeline.model.radiosity import RadiosityTerm
from pipeline.model.term import Axes, ReflectanceColumns
from pipeline.model.tilt import gathered, placed


@dataclass(frozen=True)
class Kernel:
    """A symmetric (V, V) matrix near + basis @ diag(weight) @ basis.T. basis: (V, k); weight: (k,)."""

    near: sparse.csr_array
    basis: F32
    weight: F32

    def __call__(self, vectors: F64) -> F64:
        """(n, V) products with the rows of (n, V)."""
        columns = np.ascontiguousarray(vectors.T, np.float32)
        out = self.near @ columns
        if len(self.weight):
            out = out + self.basis @ (self.weight[:, None] * (self.basis.T @ columns))
        return np.asarray(out.T, np.float64)


@dataclass(frozen=True)
class FactorisedTerm(RadiosityTerm):
    """pair: (2, N) vertices near each other, the first not above the second; near: (L, N) what the pairs' entries of
    R_d are beyond the far part; basis: (L, V, k) and weight: (L, k), the far part; error: (L,) bounds of the norm of
    what is left of R_d, as an operator on densities over the surface. tilt_*: the same of the `tilt_kernel`, and of the
    operator from first moments to radiosity that it makes; None where directions change nothing.
    """

    kind: ClassVar[str] = "factorised"

    pair: Annotated[I64, Axes("end pair", "1", kind="i")]
    near: Annotated[F32, Axes("laser pair", "mm^-2")]
    basis: Annotated[F32, Axes("laser vertex rank", "1")]
    weight: Annotated[F32, Axes("laser rank", "mm^-2")]
    error: Annotated[F64, Axes("laser", "1")]
    tilt_near: Annotated[F32 | None, Axes("laser pair", "mm^-3")] = None
    tilt_basis: Annotated[F32 | None, Axes("laser vertex tilted", "1")] = None
    tilt_weight: Annotated[F32 | None, Axes("laser tilted", "mm^-3")] = None
    tilt_error: Annotated[F64 | None, Axes("laser", "1")] = None

    @property
    def by_direction(self) -> bool:
        """Whether there is a kernel for directions."""
        return self.tilt_near is not None

    def check(self, lasers: int, vertices: int) -> None:
        """Raises: ValueError as every term, and for pairs of vertices that are not there."""
        super().check(lasers, vertices)
        parts = [self.tilt_near, self.tilt_basis, self.tilt_weight, self.tilt_error]
        if len({part is None for part in parts}) > 1:
            raise ValueError(f"{self.kind}.tilt: its arrays come together")
        if len(self.pair) != 2 or (self.pair.size and not 0 <= self.pair.min() <= self.pair.max() < vertices):
            raise ValueError(f"{self.kind}.pair: names vertices that are not there")

    @cached_property
    def kernels(self) -> tuple[Kernel, ...]:
        """R_d, by laser."""
        return self._kernels(self.near, self.basis, self.weight)

    @cached_property
    def tilt_kernels(self) -> tuple[Kernel, ...]:
        """By laser; none where directions change nothing."""
        if self.tilt_near is None or self.tilt_basis is None or self.tilt_weight is None:
            return ()
        return self._kernels(self.tilt_near, self.tilt_basis, self.tilt_weight)

    def _kernels(self, near: F32, basis: F32, weight: F32) -> tuple[Kernel, ...]:
        first, second = self.pair
        both = first != second
        at = np.concatenate([first, second[both]]), np.concatenate([second, first[both]])
        shape = (basis.shape[1],) * 2
        entries = (np.concatenate([one, one[both]]) for one in near)
        return tuple(
            Kernel(sparse.csr_array((own, at), shape=shape), np.ascontiguousarray(b), w)
            for own, b, w in zip(entries, basis, weight, strict=True)
        )

    def radiosity(self, flux: F64, points: F64) -> F64:
        """Lasers side by side: the products leave the interpreter."""
        centred = points - points.mean(axis=0)  # less is lost where positions cancel

        def one(laser: int) -> F64:
            own = flux[:, laser]
            radiosity = self.kernels[laser](own[:1])
            if not self.tilt_kernels:
                return radiosity
            out = gathered(self.tilt_kernels[laser](placed(own, centred)), centred)
            out[0] += radiosity[0]
            return out

        _ = self.kernels, self.tilt_kernels  # not by two threads at once
        with ThreadPoolExecutor(max_workers=2) as threads:
            return np.stack(list(threads.map(one, range(self.lasers))), axis=1)

    def error_bound(self, flux: F64, area: F64) -> F64:
        """(1 or 4, L) the most that `radiosity` can be off, as rms over the surface in W/mm^2: of the radiosity, and of
        each component of its moments. flux: as `radiosity` takes it; area: (V,) mm^2 of the hat functions.
        """
        density = np.sqrt((flux**2 / area).sum(axis=2) / area.sum())  # rms over the surface
        if self.tilt_error is None:
            return np.asarray(density[:1] * self.error)
        moment = self.tilt_error * density[0]
        along = self.tilt_error * np.sqrt((density[1:] ** 2).sum(axis=0))
        return np.stack([self.error * density[0] + along, moment, moment, moment])

    def reflectance_columns(self, vertices: Sequence[int] | I64) -> ReflectanceColumns:
        """Columns of the product; which entries were measured is no longer known."""
        unit = np.zeros((len(vertices), self.basis.shape[1]))
        unit[np.arange(len(vertices)), vertices] = 1.0
        mean = np.stack([kernel(unit) for kernel in self.kernels])
        return ReflectanceColumns(mean, None, np.zeros(unit.shape, bool))
