"""Least squares against plain Gauss-Newton iterations in NumPy."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from hw.base.errors import DiscoError
from pipeline.calibrate import least_squares
from pipeline.calibrate.least_squares import Huber, Linearised, Prior, minimise

F64 = NDArray[np.float64]

AT = np.linspace(0.0, 4.0, 40)
TRUE = np.array([2.0, 0.7])


def circle(x: F64) -> F64:
    """(40, 2) points of a spiral whose size and pace are unknown."""
    return np.column_stack([x[0] * AT * np.cos(x[1] * AT), x[0] * AT * np.sin(x[1] * AT)])


def derivative(x: F64) -> F64:
    """(80, 2)."""
    c, s = np.cos(x[1] * AT), np.sin(x[1] * AT)
    return np.stack([np.stack([AT * c, AT * s], 1), x[0] * AT[:, None] ** 2 * np.stack([-s, c], 1)], 2).reshape(-1, 2)


def seen(outliers: int) -> F64:
    rng = np.random.default_rng(3)
    out = circle(TRUE) + 0.05 * rng.standard_normal((len(AT), 2))
    out[rng.permutation(len(AT))[:outliers]] += rng.uniform(0.3, 3.0, (outliers, 1))
    return out


PRIOR = Prior(np.array([1.9, 0.8]), np.array([[40.0, 10.0], [10.0, 90.0]]))


def iterated(measured: F64, limit: float, cut: float) -> tuple[F64, F64]:
    """The unknowns and their precision by a hundred reweighted steps; weights are of the points' distances."""
    x = PRIOR.mean
    for _ in range(100):
        rest, j = (circle(x) - measured) / 0.05, derivative(x).reshape(-1, 2, 2) / 0.05
        size = np.linalg.norm(rest, axis=1)
        weight = np.where(size > cut, 0.0, 1.0 / np.maximum(size / limit, 1.0))
        precision = np.einsum("n,nkp,nkq->pq", weight, j, j) + PRIOR.precision
        gradient = np.einsum("n,nkp,nk->p", weight, j, rest) + PRIOR.precision @ (x - PRIOR.mean)
        x = x - np.linalg.solve(precision, gradient)
    return x, precision


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize(("outliers", "limit", "cut"), [(0, 1e9, np.inf), (8, 2.0, np.inf), (8, 2.0, 5.0)])
def test_the_minimum_is_where_reweighted_steps_end(outliers: int, limit: float, cut: float, exact: bool) -> None:
    """Tolerance: a thousandth of the standard deviations."""
    measured = seen(outliers)
    found = minimise(
        lambda x: (circle(x) - measured).ravel() / 0.05,
        PRIOR.mean,
        PRIOR,
        (lambda x: derivative(x) / 0.05) if exact else None,
        Huber(limit, cut, width=2),
    )
    x, precision = iterated(measured, limit, cut)
    sigma = np.sqrt(np.diag(np.linalg.inv(precision)))
    np.testing.assert_allclose((found.value - x) / sigma, 0.0, atol=1e-3)
    np.testing.assert_allclose(found.precision, precision, rtol=1e-3)
    assert (np.abs(x - TRUE) < 4 * sigma).all()


def test_unknowns_without_a_prior_follow_the_measurements_alone() -> None:
    j = np.random.default_rng(0).standard_normal((9, 3))
    y = np.arange(9.0)
    prior = Prior.independent(np.zeros(3), np.array([np.inf, 0.5, np.inf]))
    found = minimise(lambda x: j @ x - y, np.ones(3), prior)
    rows = np.vstack([j, [0.0, 2.0, 0.0]])
    np.testing.assert_allclose(found.value, np.linalg.lstsq(rows, np.append(y, 0.0), rcond=None)[0], atol=1e-8)
    step = Linearised(np.ones(3), j @ np.ones(3) - y, j, np.ones(9), prior).step()
    np.testing.assert_allclose(np.ones(3) + step, found.value, atol=1e-8)


def test_groups_that_err_together_count_as_one() -> None:
    """Rationale: a fit of a level to ten groups of a hundred equal values each knows it as ten values do, not as
    a thousand; one group's gradient is the sum of its members'.
    """
    level = np.random.default_rng(1).standard_normal(10)
    group = np.repeat(np.arange(10), 100)
    mean = level.mean()
    flat = Prior.independent(np.zeros(1), np.array([np.inf]))
    fit = Linearised(np.array([mean]), mean - level[group], np.ones((1000, 1)), np.ones(1000), flat)
    inverse = np.linalg.inv(fit.precision)
    variance = (inverse @ fit.scatter(group) @ inverse)[0, 0]
    assert variance == pytest.approx(level.var(ddof=1) / 10, rel=1e-12)


def test_values_that_are_not_finite_are_refused() -> None:
    j = np.eye(2)
    for residual, jacobian in ((lambda x: x * np.nan, lambda x: j), (lambda x: x, lambda x: j * np.nan)):
        with pytest.raises(DiscoError, match="not finite"):
            minimise(residual, np.ones(2), PRIOR, jacobian)
    with pytest.raises(DiscoError, match="not finite"):
        Linearised(np.ones(2), np.array([1.0, np.nan]), j, np.ones(2), PRIOR).step()


def test_a_free_unknown_is_refused() -> None:
    free = Prior.independent(np.zeros(2), np.array([1.0, np.inf]))
    fit = Linearised(np.ones(2), np.ones(3), np.outer(np.ones(3), [1.0, 0.0]), np.ones(3), free)
    for refuse in (fit.step, lambda: fit.covariance):
        with pytest.raises(DiscoError, match="unknowns free"):
            refuse()


def test_the_covariance_is_the_precisions_inverse() -> None:
    j = np.random.default_rng(2).standard_normal((6, 2))
    fit = Linearised(np.ones(2), np.ones(6), j, np.ones(6), PRIOR)
    np.testing.assert_array_equal(fit.covariance, np.linalg.inv(fit.precision))


def test_a_fit_that_does_not_converge_is_reported(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    measured = seen(0)
    minimise(lambda x: (circle(x) - measured).ravel(), PRIOR.mean, PRIOR)
    assert not caplog.text
    monkeypatch.setattr(least_squares, "least_squares", partial(least_squares.least_squares, max_nfev=2))
    minimise(lambda x: (circle(x) - measured).ravel(), PRIOR.mean, PRIOR)
    assert "2 unknowns was stopped after 2 steps" in caplog.text
