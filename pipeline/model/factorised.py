"""Relighting at interactive rates: R_d as a sparse near part and a far part of low rank, with a bound of the error.

Vertices are gathered in small patches. Between near patches R_d is steep, but there are few such pairs: their entries
are exact. Between two others it is smooth: a product of few functions on the one patch, of few on the other, and of a
small matrix that couples them. So every part of R_d is held to its own size, the dark ones too. A light then costs
O(V near + modes^2) in place of O(V^2). Angular moments go the same way, by a kernel of their own
(`pipeline.model.tilt.tilt_kernel`) on the same functions. `pipeline.model.factorise` makes such terms.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar

import numpy as np

from hw.base.arrays import F32, F64, I64
from pipeline.model.radiosity import RadiosityTerm
from pipeline.model.term import Axes, ReflectanceColumns
from pipeline.model.tilt import gathered, placed

_MODES = "laser mode_in mode_out"


class Kernel:
    """A symmetric (V, V) matrix: entries at pairs, and a product of functions on patches with their coupling.

    pair: (2, N), near: (N,), patch: (V,), basis: (V, k), coupling: (C k, C k), as in `FactorisedTerm`. Blocks between
    patches of one (padded) size multiply several times faster than single entries.
    """

    def __init__(self, pair: I64, near: F32, patch: I64, basis: F32, coupling: F32) -> None:
        self.coupling = coupling
        count = np.bincount(patch)
        self._patches, self._size = len(count), int(count.max())
        order = np.argsort(patch, kind="stable")
        place = np.empty(len(patch), np.int64)
        place[order] = np.arange(len(patch)) - np.repeat(np.cumsum(count) - count, count)
        self._slot = patch * self._size + place  # of a vertex among its patch's padded ones
        self._basis = np.zeros((self._patches, self._size, basis.shape[1]), np.float32)
        self._basis[patch, place] = basis
        both = pair[0] != pair[1]
        row, column = (np.concatenate([pair[k], pair[1 - k][both]]) for k in (0, 1))
        number, block = np.unique(patch[row] * self._patches + patch[column], return_inverse=True)
        self._blocks = np.zeros((len(number), self._size, self._size), np.float32)
        self._blocks[block, place[row], place[column]] = np.concatenate([near, near[both]])
        self._column = number % self._patches
        self._starts = np.searchsorted(number // self._patches, np.arange(self._patches))

    def __call__(self, vectors: F64) -> F64:
        """(n, V) products with the rows of (n, V)."""
        columns = self.padded(vectors)
        return self.gathered([self.half(columns, n) for n in range(2)])

    def padded(self, vectors: F64) -> F32:
        """(C, size, n) by patch, from (n, V)."""
        out = np.zeros((self._patches * self._size, len(vectors)), np.float32)
        out[self._slot] = vectors.T
        return out.reshape(self._patches, self._size, -1)

    def half(self, columns: F32, number: int) -> F32:
        """First or second half of the patches of the product with what `padded` returns: both can be done at once."""
        middle, rank = self._patches // 2, self._basis.shape[2]
        own = slice(0, middle) if number == 0 else slice(middle, self._patches)
        starts = self._starts[own]
        if not len(starts):
            return columns[own]
        blocks = slice(starts[0], len(self._blocks) if number else self._starts[middle])
        out = np.add.reduceat(self._blocks[blocks] @ columns[self._column[blocks]], starts - starts[0], axis=0)
        if rank:
            entering = (self._basis.swapaxes(1, 2) @ columns).reshape(self._patches * rank, -1)
            leaving = self.coupling[own.start * rank : own.stop * rank] @ entering
            out += self._basis[own] @ leaving.reshape(len(starts), rank, -1)
        return np.asarray(out)

    def gathered(self, halves: Sequence[F32]) -> F64:
        """(n, V) from both halves."""
        out = np.concatenate(halves).reshape(self._patches * self._size, -1)
        return np.asarray(out[self._slot].T, np.float64)


@dataclass(frozen=True)
class FactorisedTerm(RadiosityTerm):
    """pair: (2, N) vertices of near patches, the first not above the second; near: (L, N) R_d there; patch: (V,) number
    of a vertex's patch; basis: (L, V, k) values of its patch's k functions; coupling: (L, C k, C k) of the functions of
    all C patches, nothing between near ones; error: (L,) bounds of the norm of what is left of R_d, as an operator on
    densities over the surface. tilt_*: the same of the `tilt_kernel`, and of the operator from first moments to
    radiosity that it makes; None where directions change nothing.
    """

    kind: ClassVar[str] = "factorised"

    pair: Annotated[I64, Axes("end pair", "1", kind="i")]
    near: Annotated[F32, Axes("laser pair", "mm^-2")]
    patch: Annotated[I64, Axes("vertex", "1", kind="i")]
    basis: Annotated[F32, Axes("laser vertex rank", "1")]
    coupling: Annotated[F32, Axes(_MODES, "mm^-2")]
    error: Annotated[F64, Axes("laser", "1")]
    tilt_near: Annotated[F32 | None, Axes("laser pair", "mm^-3")] = None
    tilt_coupling: Annotated[F32 | None, Axes(_MODES, "mm^-3")] = None
    tilt_error: Annotated[F64 | None, Axes("laser", "1")] = None

    @property
    def by_direction(self) -> bool:
        """Whether there is a kernel for directions."""
        return self.tilt_near is not None

    def check(self, lasers: int, vertices: int) -> None:
        """Raises: ValueError as every term, and for pairs of vertices or patches that are not there."""
        super().check(lasers, vertices)
        parts = [self.tilt_near, self.tilt_coupling, self.tilt_error]
        if len({part is None for part in parts}) > 1:
            raise ValueError(f"{self.kind}.tilt: its arrays come together")
        if len(self.pair) != 2 or (self.pair.size and not 0 <= self.pair.min() <= self.pair.max() < vertices):
            raise ValueError(f"{self.kind}.pair: names vertices that are not there")
        rank, modes = self.basis.shape[2], self.coupling.shape[1]
        if rank and (modes % rank or not 0 <= self.patch.min() <= self.patch.max() < modes // rank):
            raise ValueError(f"{self.kind}.patch: names patches that are not there")

    @cached_property
    def kernels(self) -> tuple[Kernel, ...]:
        """R_d, by laser."""
        return self._kernels(self.near, self.coupling)

    @cached_property
    def tilt_kernels(self) -> tuple[Kernel, ...]:
        """By laser; none where directions change nothing."""
        if self.tilt_near is None or self.tilt_coupling is None:
            return ()
        return self._kernels(self.tilt_near, self.tilt_coupling)

    def _kernels(self, near: F32, coupling: F32) -> tuple[Kernel, ...]:
        parts = zip(near, self.basis, coupling, strict=True)
        return tuple(Kernel(self.pair, n, self.patch, b, c) for n, b, c in parts)

    def radiosity(self, flux: F64, points: F64) -> F64:
        """On two threads: the products leave the interpreter."""
        centred = points - points.mean(axis=0)  # less is lost where positions cancel
        kernels = self.kernels + self.tilt_kernels
        vectors = [flux[:1, laser] for laser in range(self.lasers)]
        vectors += [placed(flux[:, laser], centred) for laser in range(len(self.tilt_kernels))]
        columns = [kernel.padded(own) for kernel, own in zip(kernels, vectors, strict=True)]
        jobs = [(kernel, own, n) for kernel, own in zip(kernels, columns, strict=True) for n in range(2)]
        with ThreadPoolExecutor(max_workers=2) as threads:
            halves = list(threads.map(lambda job: job[0].half(*job[1:]), jobs))
        products = [kernel.gathered(halves[2 * n : 2 * n + 2]) for n, kernel in enumerate(kernels)]
        out = np.stack(products[: self.lasers], axis=1)
        if self.tilt_kernels:
            plain = out[0]
            out = np.stack([gathered(product, centred) for product in products[self.lasers :]], axis=1)
            out[0] += plain
        return out

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
        unit = np.zeros((len(vertices), len(self.patch)))
        unit[np.arange(len(vertices)), vertices] = 1.0
        mean = np.stack([kernel(unit) for kernel in self.kernels])
        return ReflectanceColumns(mean, None, np.zeros(unit.shape, bool))
