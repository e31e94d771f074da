"""From the terms of a finished model to factorised ones, and how far off those are at most.

Near entries are exact whatever the far part says of them, so the far part need only fit the others: its values at near
pairs are free. Block power iteration with Rayleigh and Ritz's projection finds it, the free entries filled in anew from
one pass to the next (Mazumder, Hastie, Tibshirani 2010, hard thresholds).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from scipy import sparse
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from hw.base.arrays import F32, F64, I64
from hw.base.errors import InputError
from pipeline.geometry.mesh import RayMesh
from pipeline.model.factorised import FactorisedTerm
from pipeline.model.lambertian import LambertianTerm
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.model.term import Term
from pipeline.model.tilt import TiltLaw, tilt_kernel

_OVERSAMPLED, _PASSES = 16, 10
_PROBES, _POWER, _ALPHA = 6, 12, 10.0  # the stated bound holds but for one time in _ALPHA ** _PROBES
_ROWS = 1024


@dataclass(frozen=True)
class Truncation:
    """near: entries that are kept exactly, a row on average; rank: of the far part; tilt_rank: of that by direction."""

    near: int = 96
    rank: int = 128
    tilt_rank: int = 48


def factorised(model: RelightableModel, truncation: Truncation | None = None) -> RelightableModel:
    """The same model with factorised terms, for many lights. Raises: InputError for a term that nothing factorises."""
    cut = truncation or Truncation()
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
    pair = near_pairs(points, cut.near)
    parts = [_split(one * np.outer(root, root).astype(np.float32), pair, cut.rank, root) for one in term.reflectance]
    near, basis, weight, error = (np.stack(column) for column in zip(*parts, strict=True))
    plain = FactorisedTerm(pair, near, basis, weight, error)
    if term.tilt is None or term.tilt_distance is None:
        return plain
    tilted = []
    for one, slopes in zip(term.reflectance, term.tilt, strict=True):
        kernel, law = np.empty_like(one), TiltLaw(term.tilt_distance, slopes)
        for rows in (slice(first, first + _ROWS) for first in range(0, len(points), _ROWS)):
            kernel[rows] = tilt_kernel(one[rows], cdist(points[rows], points), law) * np.outer(root[rows], root)
        tilted.append(_split(kernel, pair, cut.tilt_rank, root, points))
    near, basis, weight, error = (np.stack(column) for column in zip(*tilted, strict=True))
    return replace(plain, tilt_near=near, tilt_basis=basis, tilt_weight=weight, tilt_error=error)


def _lambertian(term: Term, mesh: trimesh.Trimesh, cut: Truncation) -> FactorisedTerm:
    """Exact: a diagonal."""
    assert isinstance(term, LambertianTerm)
    area = RayMesh.of(mesh).vertex_areas
    lasers, count = term.albedo.shape
    nothing, none = np.zeros((lasers, count, 0), np.float32), np.zeros((lasers, 0), np.float32)
    own = np.arange(count)
    return FactorisedTerm(
        np.stack([own, own]), (term.albedo / area).astype(np.float32), nothing, none, np.zeros(lasers)
    )


# Each kind of term that can be made fast, and how: terms on texels (local kernels) get their entry here.
FACTORISE: Mapping[type[Term], Callable[[Term, trimesh.Trimesh, Truncation], FactorisedTerm]] = {
    GlobalTerm: _global,
    LambertianTerm: _lambertian,
    FactorisedTerm: lambda term, mesh, cut: term,  # type: ignore[dict-item, return-value]
}


def near_pairs(points: F64, near: int) -> I64:
    """(2, N) pairs (i, j), i <= j, not farther apart than the radius within which a row has `near` on average."""
    tree = KDTree(points)
    near = min(near, len(points))
    radius = float(np.median(tree.query(points, k=[near])[0]))
    off = tree.query_pairs(radius, output_type="ndarray").astype(np.int64)
    own = np.arange(len(points))
    pair = np.concatenate([np.stack([own, own], axis=1), np.sort(off, axis=1)])
    return np.ascontiguousarray(pair[np.lexsort(pair.T[::-1])].T)


def _split(matrix: F32, pair: I64, rank: int, root: F64, points: F64 | None = None) -> tuple[F32, F32, F32, float]:
    """(N,) near, (V, k) basis, (k,) weight of a matrix, given as root x root times it, and the bound of what is left.

    points: of a kernel for directions, whose bound is that of the operator from first moments.
    """
    first, second = pair
    entries, rank = matrix[first, second], min(rank, len(root))
    both = first != second
    at = np.concatenate([first, second[both]]), np.concatenate([second, first[both]])

    def symmetric(values: F32) -> sparse.csr_array:
        return sparse.csr_array((np.concatenate([values, values[both]]), at), shape=matrix.shape)

    def far_at_pairs(basis: F32, weight: F32) -> F32:
        out, weighted = np.empty(len(first), np.float32), basis * weight
        for some in (slice(n, n + 65536) for n in range(0, len(first), 65536)):
            out[some] = np.einsum("nk,nk->n", weighted[first[some]], basis[second[some]])
        return out

    width = min(rank + _OVERSAMPLED, len(root))
    block = np.linalg.qr(np.random.default_rng(0).standard_normal((len(root), width), np.float32))[0]
    near = entries
    for _ in range(_PASSES):
        product = matrix @ block - symmetric(near) @ block
        small = block.T @ product
        weight, turn = np.linalg.eigh(0.5 * (small + small.T))
        best = np.argsort(-np.abs(weight))[:rank]
        basis, weight = block @ turn[:, best], weight[best]
        near = entries - far_at_pairs(basis, weight)
        block = np.linalg.qr(product)[0]
    rest, far = symmetric(near), weight

    def left(vectors: F32) -> F32:
        return np.asarray(matrix @ vectors - rest @ vectors - basis @ (far[:, None] * (basis.T @ vectors)), np.float32)

    scale = root.astype(np.float32)
    bound = _norm_bound(left, len(root)) if points is None else _tilt_bound(left, points)
    return near / (scale[first] * scale[second]), np.asarray(basis / scale[:, None]), weight.astype(np.float32), bound


def _norm_bound(operator: Callable[[F32], F32], size: int) -> float:
    """Bound of a symmetric operator's norm: of its _POWER-th power (Halko, Martinsson, Tropp 2011, lemma 4.1), whose
    root loses little. Holds but for one time in _ALPHA ** _PROBES.
    """
    vectors, log_scale = np.random.default_rng(1).standard_normal((size, _PROBES)), 0.0
    for _ in range(_POWER):
        vectors = operator(vectors.astype(np.float32)).astype(np.float64)
        largest = float(np.linalg.norm(vectors, axis=0).max())
        if largest == 0:
            return 0.0
        vectors, log_scale = vectors / largest, log_scale + np.log(largest)
    return float(np.exp((np.log(_ALPHA * np.sqrt(2 / np.pi)) + log_scale) / _POWER))


def _tilt_bound(kernel: Callable[[F32], F32], points: F64) -> float:
    """Bound of the norm of T, first moments p (3, V) to radiosity: T p = sum_c x_c (E p_c) - E (x_c p_c), of the
    symmetric E that is left of the kernel. T applied to its own transpose is symmetric on (V,).
    """
    x = points.astype(np.float32)

    def both(vectors: F32) -> F32:
        count = vectors.shape[1]
        plain, *moved = np.split(kernel(np.hstack([vectors, *(x[:, [c]] * vectors for c in range(3))])), 4, axis=1)
        back = [moved[c] - x[:, [c]] * plain for c in range(3)]
        *ahead, own = np.split(kernel(np.hstack([*back, sum(x[:, [c]] * back[c] for c in range(3))])), 4, axis=1)
        assert own.shape[1] == count
        return np.asarray(sum(x[:, [c]] * ahead[c] for c in range(3)) - own, np.float32)

    return float(np.sqrt(_norm_bound(both, len(points))))
