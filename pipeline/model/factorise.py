"""From the terms of a finished model to factorised ones, and how far off those are at most.

Patches are halves of halves of the mesh, across its longest extent. A patch's functions are the principal ones of R_d's
columns there, each column of a far vertex scaled to one: where R_d is dark it counts as much as where it is bright.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from scipy import sparse
from scipy.spatial.distance import cdist

from hw.base.arrays import F32, F64, I64, Bool
from hw.base.errors import InputError
from pipeline.geometry.mesh import RayMesh
from pipeline.model.factorised import FactorisedTerm, Kernel
from pipeline.model.lambertian import LambertianTerm
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.model.term import Term
from pipeline.model.tilt import TiltLaw, tilt_kernel

LARGE = 4000  # vertices, above which patches are larger
_PROBES, _POWER, _ALPHA = 6, 12, 10.0  # the stated bound holds but for one time in _ALPHA ** _PROBES
_ROWS = 1024


@dataclass(frozen=True)
class Truncation:
    """near: entries that are kept exactly, a row on average, at most; patch: vertices in one, at most; rank: functions
    on a patch
    """

    near: int = 128
    patch: int = 16
    rank: int = 8

    @classmethod
    def of(cls, vertices: int) -> Truncation:
        """What serves a mesh of this size."""
        return cls() if vertices <= LARGE else cls(224, 32, 6)


def factorised(model: RelightableModel, truncation: Truncation | None = None) -> RelightableModel:
    """The same model with factorised terms, for many lights. Raises: InputError for a term that nothing factorises."""
    cut = truncation or Truncation.of(len(model.mesh.vertices))
    terms = []
    for term in model.terms:
        if type(term) not in FACTORISE:
            known = ", ".join(kind.kind for kind in FACTORISE)
            raise InputError(
                "this kind of term cannot be factorised", key="terms", value=term.kind, allowed=known,
                remedy="relight with the model itself, or add a function to pipeline.model.factorise.FACTORISE",
            )  # fmt: skip
        terms.append(FACTORISE[type(term)](term, model.mesh, cut))
    return replace(model, terms=tuple(terms))


def _global(term: Term, mesh: trimesh.Trimesh, cut: Truncation) -> FactorisedTerm:
    assert isinstance(term, GlobalTerm)
    points, root = np.asarray(mesh.vertices, np.float64), np.sqrt(RayMesh.of(mesh).vertex_areas)
    points = points - points.mean(axis=0)
    patch = patches(points, cut.patch)
    near, pair = near_patches(points, patch, cut.near)
    bases = np.stack([_functions(one, patch, near, cut.rank) for one in term.reflectance])
    parts = [_split(one, patch, pair, near, b) for one, b in zip(term.reflectance, bases, strict=True)]
    entries, couplings = (np.stack(column) for column in zip(*parts, strict=True))
    errors = []
    for one, basis, (values, coupling) in zip(term.reflectance, bases, parts, strict=True):
        left = _norm_bound(_left(one, Kernel(pair, values, patch, basis, coupling), root), len(root))
        errors.append(left + _rounding(one, root))
    plain = FactorisedTerm(pair, entries, patch, bases, couplings, np.array(errors))
    if term.tilt is None or term.tilt_distance is None:
        return plain
    tilted, errors = [], []
    for one, slopes, basis in zip(term.reflectance, term.tilt, bases, strict=True):
        kernel, law = np.empty_like(one), TiltLaw(term.tilt_distance, slopes)
        for rows in (slice(first, first + _ROWS) for first in range(0, len(points), _ROWS)):
            kernel[rows] = tilt_kernel(one[rows], cdist(points[rows], points), law)
        tilted.append(_split(kernel, patch, pair, near, basis))
        errors.append(
            _tilt_bound(_left(kernel, Kernel(pair, tilted[-1][0], patch, basis, tilted[-1][1]), root), points)
        )
    entries, couplings = (np.stack(column) for column in zip(*tilted, strict=True))
    return replace(plain, tilt_near=entries, tilt_coupling=couplings, tilt_error=np.array(errors))


def _lambertian(term: Term, mesh: trimesh.Trimesh, cut: Truncation) -> FactorisedTerm:
    """Exact: a diagonal."""
    assert isinstance(term, LambertianTerm)
    lasers, count = term.albedo.shape
    own, albedo = np.arange(count), (term.albedo / RayMesh.of(mesh).vertex_areas).astype(np.float32)
    empty = np.zeros((lasers, count, 0), np.float32), np.zeros((lasers, 0, 0), np.float32)
    return FactorisedTerm(np.stack([own, own]), albedo, own, *empty, np.zeros(lasers))


def _as_it_is(term: Term, mesh: trimesh.Trimesh, cut: Truncation) -> FactorisedTerm:
    assert isinstance(term, FactorisedTerm)
    return term


# Each kind of term that can be made fast, and how: terms on texels (local kernels) get their entry here.
FACTORISE: Mapping[type[Term], Callable[[Term, trimesh.Trimesh, Truncation], FactorisedTerm]] = {
    GlobalTerm: _global,
    LambertianTerm: _lambertian,
    FactorisedTerm: _as_it_is,
}


def patches(points: F64, size: int) -> I64:
    """(V,) number of the patch of each vertex; (V, 3) points in mm; size: vertices in a patch, at most."""
    patch, found, todo = np.zeros(len(points), np.int64), 0, [np.arange(len(points))]
    while todo:
        own = todo.pop()
        if len(own) <= size:
            patch[own] = found
            found += 1
            continue
        away = points[own] - points[own].mean(axis=0)
        order = own[np.argsort(away @ np.linalg.eigh(away.T @ away)[1][:, -1], kind="stable")]
        parts = -(-len(own) // size)
        half = round(len(own) * (parts // 2) / parts)
        todo += [order[:half], order[half:]]
    return patch


def near_patches(points: F64, patch: I64, near: int) -> tuple[Bool, I64]:
    """(C, C) which patches are near each other, and (2, N) the pairs of their vertices, the first not above the second:
    up to the gap between patches at which a row has `near` entries on average; a patch is near itself in any case.
    """
    count = np.bincount(patch)
    order = np.argsort(patch, kind="stable")
    starts = np.concatenate([[0], np.cumsum(count)[:-1]])
    gap = np.zeros((len(count),) * 2)
    for number, own in enumerate(np.split(order, starts[1:])):
        gap[number] = np.minimum.reduceat(cdist(points[own], points[order]).min(axis=0), starts)
    entries = np.multiply.outer(count, count)
    ascending = np.argsort(gap, axis=None, kind="stable")
    within = np.cumsum(entries.ravel()[ascending]) <= near * len(points)
    widest = gap.ravel()[ascending][within][-1] if within.any() else 0.0
    close = (gap < widest) | np.eye(len(count), dtype=bool)  # below: of equal gaps not some alone
    close |= close.T
    seconds = [v + np.flatnonzero(close[patch[v]][patch[v:]]) for v in range(len(points))]
    first = np.repeat(np.arange(len(points)), [len(own) for own in seconds])
    return close, np.stack([first, np.concatenate(seconds)])


def _functions(reflectance: F32, patch: I64, near: Bool, rank: int) -> F32:
    """(V, k) orthonormal on each patch; zeros where it has fewer vertices than functions."""
    basis = np.zeros((len(patch), rank), np.float32)
    for number in range(len(near)):
        own = np.flatnonzero(patch == number)
        columns = reflectance[own][:, ~near[number][patch]].astype(np.float64)
        columns /= np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        vectors = np.linalg.eigh(columns @ columns.T)[1][:, ::-1][:, :rank]
        basis[own, : vectors.shape[1]] = vectors
    return basis


def _split(matrix: F32, patch: I64, pair: I64, near: Bool, basis: F32) -> tuple[F32, F32]:
    """(N,) the near part, exactly, and (C k, C k) the best coupling of the patches' functions."""
    count, rank = basis.shape
    at = (patch[:, None] * rank + np.arange(rank)).ravel(), np.repeat(np.arange(count), rank)
    functions = sparse.csr_array((basis.ravel(), at), shape=(len(near) * rank, count))
    coupling = np.asarray(functions @ (functions @ matrix).T, np.float32)
    coupling *= ~np.kron(near, np.ones((rank, rank), bool))
    return matrix[pair[0], pair[1]], np.asarray(0.5 * (coupling + coupling.T))


def _left(matrix: F32, kernel: Kernel, root: F64) -> Callable[[F64], F64]:
    """What is left of a matrix, on densities over the surface: times the roots of the areas at either end."""

    def left(vectors: F64) -> F64:
        scaled = vectors * root[:, None]
        return np.asarray(root[:, None] * (matrix @ scaled.astype(np.float32) - kernel(scaled.T).T), np.float64)

    return left


def _rounding(matrix: F32, root: F64) -> float:
    """By how much sums in single precision are off, as an operator's norm: next to nothing is left of an R_d that is
    all near its diagonal.
    """
    sums = np.asarray(matrix, np.float64) @ root**2  # of a matrix without negative entries: its norm is no more
    return float(np.finfo(np.float32).eps * sums.max())


def _norm_bound(operator: Callable[[F64], F64], size: int) -> float:
    """Bound of a symmetric operator's norm: of its _POWER-th power (Halko, Martinsson, Tropp 2011, lemma 4.1), whose
    root loses little. Holds but for one time in _ALPHA ** _PROBES.
    """
    vectors, log_scale = np.random.default_rng(1).standard_normal((size, _PROBES)), 0.0
    for _ in range(_POWER):
        vectors = operator(vectors)
        largest = float(np.linalg.norm(vectors, axis=0).max())
        if largest == 0:
            return 0.0
        vectors, log_scale = vectors / largest, log_scale + np.log(largest)
    return float(np.exp((np.log(_ALPHA * np.sqrt(2 / np.pi)) + log_scale) / _POWER))


def _tilt_bound(kernel: Callable[[F64], F64], points: F64) -> float:
    """Bound of the norm of T, first moments p (3, V) to radiosity: T p = sum_c x_c (E p_c) - E (x_c p_c), of the
    symmetric E that is left of the kernel. T applied to its own transpose is symmetric on (V,).
    """
    x = points[:, :, None]  # (V, 3, 1)

    def both(vectors: F64) -> F64:
        plain, *moved = np.split(kernel(np.hstack([vectors, *(x[:, c] * vectors for c in range(3))])), 4, axis=1)
        back = [moved[c] - x[:, c] * plain for c in range(3)]
        *ahead, own = np.split(kernel(np.hstack([*back, sum(x[:, c] * back[c] for c in range(3))])), 4, axis=1)
        return np.asarray(sum(x[:, c] * ahead[c] for c in range(3)) - own)

    return float(np.sqrt(_norm_bound(both, len(points))))
