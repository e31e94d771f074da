"""Least squares with prior knowledge, robust weights and the covariance of what was found.

`minimise` is scipy's trust-region solver, with the prior's rows under the measurements' and a loss of whole vectors
(misses across a beam, say). `Linearised` is one step of it: for measurements that are made anew at every step, such as
edges along an outline, and for weights that come from the model's own mean.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from hw.base.arrays import F64, I64
from hw.base.outcome import CONVERGED, Ended, Outcome, Unsolved

log = logging.getLogger(__name__)

END = 1e-10  # relative change of the sum or of the unknowns: far below any error bar


@dataclass(frozen=True)
class Prior:
    """What is known before: unknowns of (P,) `mean`, with the (P, P) inverse covariance `precision`."""

    mean: F64
    precision: F64

    @classmethod
    def independent(cls, mean: F64, sigma: F64) -> Prior:
        """Of (P,) standard deviations; infinite where nothing is known."""
        return cls(mean, np.diag(np.asarray(sigma, np.float64) ** -2))


@dataclass(frozen=True)
class Huber:
    """Residuals up to `limit` count by their squares, larger ones by their size (Huber 1964); beyond `cut`, not at all.

    width: components of one residual, whose common size counts
    """

    limit: float
    cut: float = np.inf
    width: int = 1

    def size(self, residual: F64) -> F64:
        """(K / width,) sizes of (K,) components."""
        return np.asarray(np.linalg.norm(residual.reshape(-1, self.width), axis=1))

    def weight(self, residual: F64) -> F64:
        """(K,) by which the squares of the components count."""
        size = self.size(residual)
        weight = np.where(size > self.cut, 0.0, 1.0 / np.maximum(size / self.limit, 1.0))
        return np.repeat(weight, self.width)

    def cost(self, residual: F64) -> F64:
        """(K,) what the components add to the sum of squares."""
        size = np.minimum(self.size(residual), self.cut)
        cost = np.where(size > self.limit, self.limit * (2 * size - self.limit), size**2)
        return np.repeat(cost / self.width, self.width)


SQUARES = Huber(np.inf)


@dataclass(frozen=True)
class Linearised:
    """K residuals f (model less measurement) at the unknowns' `value`, their (K, P) Jacobian, and (K,) weights.

    ended: how the iteration ended that led here
    """

    value: F64
    residual: F64
    jacobian: F64
    weight: F64
    prior: Prior
    ended: Ended = CONVERGED

    @cached_property
    def information(self) -> F64:
        """(P, P) J^T W J: what the measurements alone tell."""
        return np.asarray((self.jacobian * self.weight[:, None]).T @ self.jacobian)

    @property
    def precision(self) -> F64:
        """(P, P) inverse covariance of the unknowns, if the weights are the measurements' own and the prior holds."""
        return np.asarray(self.information + self.prior.precision)

    @property
    def covariance(self) -> F64:
        """(P, P) inverse of `precision`. Raises: Unsolved where an unknown is free, or a value not finite."""
        return _solved(self.precision, np.eye(len(self.value)))

    def step(self) -> F64:
        """(P,) to the minimum of the linearised sum (Gauss and Newton). Raises: Unsolved as `covariance`."""
        pull = self.prior.precision @ (self.value - self.prior.mean)
        return -_solved(self.precision, self.jacobian.T @ (self.weight * self.residual) + pull)

    def scatter(self, group: I64, parameters: int | None = None, about_mean: bool = False) -> F64:
        """(P, P) covariance of the gradient, from how it differs between groups of measurements that err together.

        group: (K,) numbers; parameters: P, but for unknowns that belong to one group each. With it the covariance of
        the unknowns is C (scatter + prior) C, C = inverse precision: the sandwich estimator, clustered (Liang and Zeger
        1986, eq. 6), for a few groups raised as by lost freedoms, at most fourfold.
        """
        scores = np.zeros((group.max(initial=0) + 1, len(self.value)))
        np.add.at(scores, group, self.jacobian * (self.weight * self.residual)[:, None])
        scores = scores[np.abs(scores).sum(axis=1) > 0]
        if about_mean:
            scores = scores - scores.mean(axis=0)
        count, lost = len(scores), len(self.value) if parameters is None else parameters
        return np.asarray(scores.T @ scores * count / max(count - lost, count / 4, 1))


def minimise(
    residual: Callable[[F64], F64],
    start: F64,
    prior: Prior,
    jacobian: Callable[[F64], F64] | None = None,
    loss: Huber = SQUARES,
) -> Linearised:
    """The unknowns where the sum of squares is least, linearised there.

    residual: (P,) unknowns -> (K,); jacobian: unknowns -> (K, P), otherwise by central differences; loss: of the
    residuals, not of the prior

    What is returned says how it `ended`: stopped, it is for the caller to use or to refuse. Raises: Unsolved where
    residuals at the start, or derivatives, are not finite.
    """
    derivative = jacobian or partial(_differences, residual)
    values, vectors = np.linalg.eigh(prior.precision)
    known = values > 0  # what nothing is known of has no row
    root = np.sqrt(values[known])[:, None] * vectors.T[known]

    def rows(x: F64) -> F64:
        return np.concatenate([residual(x), root @ (x - prior.mean)])

    def derivatives(x: F64) -> F64:
        return _finite(np.concatenate([derivative(x), root]))

    def rho(squares: F64) -> F64:
        sizes, linear = np.split(squares, [len(squares) - len(root)])
        cost, weight = loss.cost(np.sqrt(sizes)), loss.weight(np.sqrt(sizes))
        of_prior = [linear, np.ones_like(linear), np.zeros_like(linear)]
        return np.concatenate([[cost, weight, np.zeros_like(cost)], of_prior], axis=1)

    given: Any = rho  # scipy's stubs expect more of it than scipy
    _finite(rows(start))
    found = least_squares(rows, start, derivatives, loss=given, x_scale="jac", ftol=END, xtol=END, gtol=END)
    ended = Ended(Outcome.CONVERGED if found.success else Outcome.STOPPED, int(found.nfev))
    ended.warn(log, f"a fit of {len(start)} unknowns")
    x = np.asarray(found.x, np.float64)
    misses = residual(x)
    return Linearised(x, misses, derivative(x), loss.weight(misses), prior, ended)


def likeliest(x: F64, cost: F64) -> tuple[float, float]:
    """Where a parabola through the lowest of (n,) chi^2 and its neighbours is lowest, and the standard error there.

    x: (n,) equally spaced values of an unknown that were all tried, three or more. At an end of them, and where costs
    do not bend upward, the lowest value itself and the error that the steeper rise beside it shows; never more than the
    range that was tried. Raises: Unsolved for costs that are not finite.
    """
    _finite(cost)
    k, step, most = int(np.argmin(cost)), x[1] - x[0], x[-1] - x[0]
    rises = [cost[j] - cost[k] for j in (k - 1, k + 1) if 0 <= j < len(cost)]
    if len(rises) < 2 or sum(rises) <= 0:
        steepest = max(rises)
        return float(x[k]), float(min(step / np.sqrt(steepest), most) if steepest > 0 else most)
    low, high = rises
    shift = 0.5 * (low - high) / (low + high)
    return float(x[k] + shift * step), float(min(step * np.sqrt(2.0 / (low + high)), most))


def _finite(values: F64) -> F64:
    """The same. Raises: Unsolved where one is not finite."""
    if not np.isfinite(values).all():
        raise Unsolved("a fit", Outcome.OUT_OF_RANGE)
    return values


def _solved(matrix: F64, right: F64) -> F64:
    try:
        return _finite(np.asarray(np.linalg.solve(matrix, right), np.float64))
    except np.linalg.LinAlgError as error:
        raise Unsolved("a fit", Outcome.SINGULAR) from error


def _differences(residual: Callable[[F64], F64], x: F64) -> F64:
    """(K, P) derivatives."""
    h = np.cbrt(np.finfo(float).eps) * np.maximum(1.0, np.abs(x))
    return np.stack([(residual(x + s) - residual(x - s)) / (2 * s.max()) for s in np.diag(h)], axis=1)
