"""Statistical acceptance: z-scores from replicates or known variances, chi-squared tests, many comparisons at once.

All tests share one rule: the chance that a right program fails is `LEVEL` per assertion, whatever the number of
values compared (Sidak's correction). Seeds are fixed, so a test that passes keeps passing.
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

F64 = NDArray[np.float64]

log = logging.getLogger(__name__)

LEVEL = 1e-3


def z_of_replicates(values: ArrayLike, truth: ArrayLike = 0.0) -> F64:
    """(N, ...) independent replicates -> (...) z-scores of their mean against `truth`.

    Student's t with N - 1 degrees of freedom, mapped to the normal score of the same probability.
    """
    values = np.asarray(values, float)
    count = len(values)
    if count < 16:
        raise ValueError("fewer than 16 replicates give misleading standard errors")
    spread = values.std(axis=0, ddof=1) / np.sqrt(count)
    t = (values.mean(axis=0) - np.asarray(truth)) / spread
    return np.asarray(np.sign(t) * stats.norm.isf(stats.t.sf(np.abs(t), count - 1)))


def z_of_difference(a: ArrayLike, b: ArrayLike) -> F64:
    """(N, ...) and (M, ...) independent replicates -> (...) z-scores of the difference of their means (Welch)."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    if min(len(a), len(b)) < 16:
        raise ValueError("fewer than 16 replicates give misleading standard errors")
    va, vb = a.var(axis=0, ddof=1) / len(a), b.var(axis=0, ddof=1) / len(b)
    t = (a.mean(axis=0) - b.mean(axis=0)) / np.sqrt(va + vb)
    dof = (va + vb) ** 2 / (va**2 / (len(a) - 1) + vb**2 / (len(b) - 1))
    return np.asarray(np.sign(t) * stats.norm.isf(stats.t.sf(np.abs(t), dof)))


def threshold(count: int, level: float = LEVEL) -> float:
    """Largest |z| that `count` right values exceed with probability `level` only."""
    return float(stats.norm.isf(-np.expm1(np.log1p(-level) / count) / 2))


def assert_z(z: ArrayLike, label: str = "", level: float = LEVEL) -> None:
    """Every z-score lies within what this many comparisons allow."""
    z = np.atleast_1d(np.asarray(z, float))
    assert np.isfinite(z).all(), f"{label}: z-scores {z}"
    limit = threshold(z.size, level)
    log.info("%s: %d z-scores, %s", label, z.size, np.round(z.ravel()[:12], 2))
    assert np.abs(z).max() < limit, f"{label}: |z| up to {np.abs(z).max():.2f} of {z.size}, allowed {limit:.2f}; {z}"


def chi_squared(counts: ArrayLike, expected: ArrayLike, fitted: int = 1) -> float:
    """p-value of Pearson's test; cells expected below ten are pooled. `fitted`: lost degrees of freedom."""
    counts, expected = np.asarray(counts, float).ravel(), np.asarray(expected, float).ravel()
    small = expected < 10
    if small.any():
        counts = np.append(counts[~small], counts[small].sum())
        expected = np.append(expected[~small], expected[small].sum())
    if expected[-1] == 0:
        assert counts[-1] == 0, "samples where the density is zero"
        counts, expected = counts[:-1], expected[:-1]
    statistic = ((counts - expected) ** 2 / expected).sum()
    return float(stats.chi2.sf(statistic, len(counts) - fitted))


def assert_chi_squared(counts: ArrayLike, expected: ArrayLike, label: str = "", level: float = LEVEL) -> None:
    """The counts follow `expected` (same total)."""
    assert np.isclose(np.sum(counts), np.sum(expected), rtol=1e-3), f"{label}: the density does not integrate to one"
    p = chi_squared(counts, expected)
    assert p > level, f"{label}: chi-squared p = {p:.2e}"


def assert_uniform(u: F64, label: str = "", bins: int = 24) -> None:
    """(n, k) points, k = 1..3, fill the unit cube evenly."""
    u = u.reshape(len(u), -1)
    assert 0 <= u.min() <= u.max() <= 1, f"{label}: outside [0, 1]"
    counts, _ = np.histogramdd(u, bins=[bins] * u.shape[1], range=[(0, 1)] * u.shape[1])
    assert_chi_squared(counts, np.full(counts.shape, len(u) / counts.size), label)
