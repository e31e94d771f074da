"""Totals: kriging against the dense formulas, expectations below a bound, scaling, and what a wild column comes to."""

from __future__ import annotations

import numpy as np
import pytest
from reconstruct_synthetic import Synthetic
from scipy.stats import multivariate_normal, truncnorm

from pipeline.geometry.mesh import RayMesh
from pipeline.reconstruct.global_term.harmonics import harmonics
from pipeline.reconstruct.global_term.totals import (
    COMMON,
    SHARED,
    SHARED_RANGE,
    Kriging,
    ObservedField,
    at_most_zero,
    scaling,
    steady_totals,
)


def test_kriging_agrees_with_the_dense_formulas() -> None:
    """Rationale: mean, variance and likelihood by the covariance matrix itself, in float64."""
    rng = np.random.default_rng(2)
    u, spectrum, noise = rng.standard_normal((40, 12)), rng.uniform(0.1, 1, 12), rng.uniform(0.1, 0.5, 40)
    shared = rng.uniform(0.05, 0.5, 12)
    observed = 3.0 + u @ (np.sqrt(spectrum) * rng.standard_normal(12)) + np.sqrt(noise) * rng.standard_normal(40)
    kriging = Kriging(ObservedField(u, noise), spectrum, shared)
    mean, variance = kriging.posterior(observed)
    signal = (u * spectrum) @ u.T
    whole, one = signal + (u * shared) @ u.T + np.diag(noise), np.ones(40)
    level = one @ np.linalg.solve(whole, observed) / (one @ np.linalg.solve(whole, one))
    np.testing.assert_allclose(mean, level + signal @ np.linalg.solve(whole, observed - level), rtol=1e-9)
    np.testing.assert_allclose(variance, np.diag(signal - signal @ np.linalg.solve(whole, signal)), rtol=1e-7)
    exact = multivariate_normal(np.full(40, level), whole).logpdf(observed) + 20 * np.log(2 * np.pi)
    assert kriging.likelihood(observed) == pytest.approx(exact, rel=1e-9)


@pytest.mark.parametrize(("mean", "deviation"), [(-3.0, 0.1), (-0.05, 0.1), (0.0, 0.1), (0.5, 0.1), (2.0, 0.02)])
def test_the_expectation_below_a_bound_is_that_of_the_truncated_distribution(mean: float, deviation: float) -> None:
    found = float(at_most_zero(np.array(mean), np.array(deviation)))
    assert found == pytest.approx(truncnorm(-np.inf, -mean / deviation, mean, deviation).mean(), abs=1e-6)
    assert found <= 0


def test_scaling_meets_the_totals() -> None:
    rng = np.random.default_rng(3)
    r, area = rng.uniform(0, 1, (30, 30)) ** 4, rng.uniform(0.5, 2, 30)
    r, wanted = r + r.T, rng.uniform(0.5, 1, 30)
    g = scaling(r, area, wanted)
    np.testing.assert_allclose(g * (r @ (g * area)), wanted, rtol=1e-3)


def test_a_wild_column_takes_its_neighbours_total_and_a_known_one_keeps_its_own(small: Synthetic) -> None:
    """Rationale: the true matrix with one vertex at 2.5 times its light, and one that is 20 % off and known exactly.
    Expected: the first comes down to what is around it, the other stays.
    """
    mesh, true = small.samples.mesh, small.truth
    area, basis, edge = RayMesh.of(mesh).vertex_areas, harmonics(mesh, 500), small.samples.edge
    level = 0.8 / (true[0] @ area).mean()
    wild, known = 20, 100
    bad, variance = true.copy(), np.full_like(true, 0.02**2)
    for vertex, factor, deviation in ((wild, 2.5, 0.6), (known, 1.2, 1e-3)):
        bad[:, vertex] *= factor
        bad[:, :, vertex] *= factor
        variance[:, vertex] = variance[:, :, vertex] = deviation**2
    steady = steady_totals(bad, variance, area, level, basis, edge)
    np.testing.assert_allclose(steady, steady.transpose(0, 2, 1), rtol=1e-12)
    before, after, exact = ((r[0] @ area) * level for r in (bad, steady, true))
    assert before[wild] > 1.5
    assert after[wild] == pytest.approx(exact[wild], rel=0.12)
    assert after[known] == pytest.approx(before[known], rel=0.06)
    others = np.delete(np.arange(len(area)), [wild, known])
    stated = np.hypot(0.02, min(COMMON))  # of a total: what its column leaves open, and what a spot's samples share
    assert np.std((after / exact)[others]) < 2 * stated


def test_no_more_leaves_than_arrives(small: Synthetic) -> None:
    """Rationale: an object that absorbs nothing, estimated with noise: half of the totals would lie above 1."""
    mesh, rng = small.samples.mesh, np.random.default_rng(5)
    area, basis = RayMesh.of(mesh).vertex_areas, harmonics(mesh, 500)
    noisy = np.exp(0.2 * rng.standard_normal(len(area)))
    bad = small.truth * noisy[:, None] * noisy
    level = 1.0 / (bad[0] @ area).mean()
    steady = steady_totals(bad, np.full_like(bad, 0.15**2), area, level, basis, small.samples.edge)
    total = (steady[0] @ area) * level
    assert total.max() < 1.0
    assert total.mean() > 0.85
    assert np.std(total) < 0.5 * np.std((bad[0] @ area) * level)


def test_totals_take_the_shape_that_is_expected_of_them(small: Synthetic) -> None:
    """Rationale: the true matrix, its columns off by errors that neighbours share. Given the true totals' shape, most
    of the error is told from the object and goes; without it, it is taken for the object.
    """
    mesh, true = small.samples.mesh, small.truth
    area, edge = RayMesh.of(mesh).vertex_areas, small.samples.edge
    basis, rng = harmonics(mesh, 500), np.random.default_rng(7)
    totals = true[0] @ area
    level = 0.5 / totals.mean()
    spectrum = 1.0 / basis.roughness(SHARED_RANGE * edge)
    amplitude = SHARED * np.sqrt(spectrum / spectrum.sum()) * rng.standard_normal(len(spectrum))
    amplitude[0] = 0.0  # the level is nobody's
    bad = true * np.exp(0.5 * (basis.functions @ amplitude))[:, None] * np.exp(0.5 * (basis.functions @ amplitude))
    variance, left = np.full_like(true, 0.02**2), {}
    for name, expected in (("given", np.log(totals)[None]), ("not", None)):
        steady = steady_totals(bad, variance, area, level, basis, edge, expected)[0] @ area
        left[name] = float(np.std(np.log(steady / totals)))
    before = float(np.std(np.log((bad[0] @ area) / totals)))
    assert left["given"] < before / 2
    assert left["not"] > 0.8 * before
