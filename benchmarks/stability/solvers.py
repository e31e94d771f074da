"""Least squares, lens inversion, scaling and kriging where matrices are singular, far from round, or say nothing."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.stability.case import Ends, Family, relative
from hw.base.arrays import F64
from pipeline.calibrate.least_squares import Huber, Linearised, Prior, likeliest, minimise
from pipeline.geometry.camera import PinholeCamera
from pipeline.reconstruct.global_term.totals import at_most_zero, scaling

FAMILY = Family("solvers")
NOTHING = Prior.independent(np.zeros(2), np.full(2, np.inf))


def straight(condition: float) -> float:
    """Stated errors by which two unknowns are off whose columns differ by 1 / condition; residuals in sigmas."""
    t = np.linspace(-1, 1, 50)
    design = np.column_stack([np.ones(50), 1 + t / condition])
    truth = np.array([2.0, -1.0])
    fit = minimise(lambda x: design @ (x - truth), np.zeros(2), NOTHING, lambda x: design)
    return float(np.abs((fit.value - truth) / np.sqrt(np.diag(fit.covariance))).max())


for condition in (1e2, 1e4, 1e6, 1e12):
    FAMILY.case(
        f"a straight line, condition {condition:.0e}",
        "the exact unknowns within a thousandth of their stated errors",
        f"condition {condition:.0e}",
        1e-3,
        ends=Ends.RIGHT if condition < 1e7 else Ends.EITHER,
    )(partial(straight, condition))


@FAMILY.case("unknowns of very different size", "both to a part in a million", "1e-9 and 1e9", 1e-6)
def sizes() -> float:
    truth, t = np.array([1e-9, 1e9]), np.linspace(0, 1, 40)
    design = np.column_stack([1e9 * np.ones(40), 1e-9 * t])
    return relative(minimise(lambda x: design @ (x - truth), np.ones(2), NOTHING, lambda x: design).value, truth)


@FAMILY.case("an unknown that nothing says anything about", "refused as singular", "condition inf", ends=Ends.REFUSED)
def free() -> float:
    j = np.outer(np.ones(3), [1.0, 0.0])
    return float(np.diag(Linearised(np.ones(2), np.ones(3), j, np.ones(3), NOTHING).covariance).sum())


@FAMILY.case(
    "two unknowns that only occur as a sum",
    "refused as singular, or a standard error beyond 1e6 of one that is known",
    "condition 1e16",
    ends=Ends.EITHER,
)
def sum_alone() -> float:
    t = np.linspace(0, 1, 40)
    j = np.column_stack([1 / 3 + t, 1 / 3 + t + 1e-17])
    fit = Linearised(np.ones(2), np.zeros(40), j, np.ones(40), NOTHING)
    return float(np.sqrt(np.diag(fit.covariance)).min() < 1e6)


@FAMILY.case("measurements that are not finite", "refused", "NaN", ends=Ends.REFUSED)
def not_finite() -> float:
    return float(minimise(lambda x: x * np.nan, np.ones(2), NOTHING).value.sum())


@FAMILY.case(
    "a valley that takes more steps than there are",
    "the minimum, or refused as stopped",
    "Rosenbrock, 1e8",
    1e-3,
    ends=Ends.EITHER,
)
def valley() -> float:
    def residual(x: F64) -> F64:
        return np.array([1e4 * (x[1] - x[0] ** 2), 1 - x[0]])

    found = minimise(residual, np.array([-12.0, 100.0]), NOTHING)
    found.ended.require("the valley's fit")
    return relative(found.value, [1.0, 1.0])


@FAMILY.case("30 % outliers of a robust line", "within 5 standard errors", "outliers 1e6 times the scatter", 5.0)
def outliers() -> float:
    rng, t = np.random.default_rng(3), np.linspace(0, 1, 200)
    design, truth = np.column_stack([np.ones(200), t]), np.array([0.3, -0.7])
    seen = design @ truth + 0.01 * rng.standard_normal(200)
    seen[rng.permutation(200)[:60]] += 1e4
    start = np.array([np.median(seen), 0.0])
    fit = minimise(lambda x: (design @ x - seen) / 0.01, start, NOTHING, lambda x: design / 0.01, Huber(2.0, 1e4))
    return float((np.abs(fit.value - truth) / np.sqrt(np.diag(fit.covariance))).max())


@FAMILY.case("costs that are all alike", "an error as wide as what was tried", "no curvature")
def flat() -> float:
    x = np.linspace(0, 1, 9)
    return abs(likeliest(x, np.full(9, 3.0))[1] - 1.0)


@FAMILY.case(
    "a parabola of 1e-12 upon 1e6", "its vertex within a step, its error within what was tried", "18 decades", 0.13
)
def shallow() -> float:
    x = np.linspace(0, 1, 9)
    at, error = likeliest(x, 1e6 + 1e-12 * (x - 0.4) ** 2)
    return abs(at - 0.4) if error <= 1 and at not in (0.0, 1.0) else (0.0 if error == 1 else np.inf)


def lens(*distortion: float) -> PinholeCamera:
    return PinholeCamera(768, 496, np.full(2, 600.0), np.array([384.0, 248.0]), np.array(distortion), np.eye(4))


for name, coefficients in (
    ("barrel", (-0.3, 0.1, 0.0, 0.0, 0.0)),
    ("pincushion", (0.6, 0.0, 1e-3, -1e-3, 0.2)),
    ("fish-eye", (-0.25, 0.0, 0, 0, 0)),
):

    @FAMILY.case(f"a {name}'s distortion undone", "the very pixels, to 1e-9", "to the picture's corners", 1e-9)
    def undone(own: tuple[float, ...] = coefficients) -> float:
        camera = lens(*own)
        pixels = np.stack(np.meshgrid(np.linspace(0, 768, 40), np.linspace(0, 496, 30)), axis=-1).reshape(-1, 2)
        xy = (pixels - camera.centre) / camera.focal
        return float(np.nan_to_num(np.abs(camera.distort(camera.undistort(xy)) - xy), nan=np.inf).max())


@FAMILY.case("a distortion beyond its fold", "NaN or refused: no direction is seen there", "k1 = -3", ends=Ends.EITHER)
def folded() -> float:
    camera = lens(-3.0, 0.0, 0.0, 0.0, 0.0)
    xy = np.array([[0.6, 0.0], [0.64, 0.41]])
    back = camera.undistort(xy)
    told = np.isnan(back).any(axis=1)
    return float((~told & (np.abs(camera.distort(back) - xy).max(axis=1) > 1e-9)).sum())


@FAMILY.case("a bounded mean far below its bound", "the mean itself", "1e8 deviations", 1e-12)
def far_below() -> float:
    return relative(at_most_zero(np.array([-1.0]), np.array([1e-8])), [-1.0])


def naive_bound(mean: float, deviation: float) -> float:
    from scipy.stats import norm

    edge = -mean / deviation
    return float(mean - deviation * norm.pdf(edge) / norm.cdf(edge))


def bound_off(formula: Callable[[float, float], float], edge: float) -> float:
    return relative(formula(1.0, 1 / edge), -1 / edge**2)


def bounded(mean: float, deviation: float) -> float:
    return float(at_most_zero(np.array([mean]), np.array([deviation]))[0])


for edge in (10.0, 1e3, 1e8):
    FAMILY.case(
        f"a bounded mean {edge:.0e} deviations above its bound",
        "-deviation^2 / mean, the tail's first order",
        f"{edge:.0e} deviations",
        0.03,
        rivals={"density over distribution": partial(bound_off, naive_bound, edge)},
    )(partial(bound_off, bounded, edge))


@FAMILY.case("a bounded mean that is known exactly", "the lesser of it and the bound", "deviation 0", 1e-12)
def known() -> float:
    return float(np.abs(at_most_zero(np.array([-2.0, 3.0]), np.zeros(2)) - [-2.0, 0.0]).max())


@FAMILY.case("scaling to totals over 12 decades", "the totals that were wanted", "1e-12 .. 1", 1e-3)
def totals() -> float:
    rng = np.random.default_rng(1)
    size = np.geomspace(1e-6, 1, 60)
    matrix = size[:, None] * size * np.exp(0.3 * rng.standard_normal((60, 60)))
    matrix, area = 0.5 * (matrix + matrix.T), rng.uniform(0.5, 2, 60)
    wanted = matrix @ area * rng.uniform(0.5, 2, 60)
    factor = scaling(matrix, area, wanted)
    return relative(factor * (matrix @ (factor * area)), wanted)


@FAMILY.case(
    "scaling where a row is empty",
    "the others meet their totals, or refused; nothing is NaN",
    "1 of 20 rows 0",
    1e-3,
    ends=Ends.EITHER,
)
def empty_row() -> float:
    matrix = np.exp(-np.abs(np.subtract.outer(np.arange(20.0), np.arange(20.0))))
    matrix[7], matrix[:, 7] = 0.0, 0.0
    wanted = np.ones(20)
    factor = scaling(matrix, np.ones(20), wanted)
    return relative(np.delete(factor * (matrix @ factor), 7), np.delete(wanted, 7))


@FAMILY.case(
    "scaling to totals that no factors give",
    "refused, or the factors that were there",
    "a bipartite matrix",
    ends=Ends.EITHER,
)
def impossible() -> float:
    matrix = np.array([[0.0, 1.0], [1.0, 0.0]])  # both rows have one total whatever the factors
    factor = scaling(matrix, np.ones(2), np.array([1.0, 4.0]))
    return float(np.abs(factor - 1).max())
