"""Rationale: a sampler that departs from its density biases everything downstream without looking wrong.

Expected behaviour: a million samples, one from each of a million consecutive photons' streams, follow the density that
the code itself uses (chi-squared at 0.1 %).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from random_streams import F64, N, azimuth, streams
from significance import assert_chi_squared, assert_uniform, assert_z

from disco_twin.light import sampling
from disco_twin.light.sampling import Rng

AXIS = np.array([0.36, -0.48, 0.8])


def samples(sampler: Callable[[Rng], Any], **key: int) -> F64:
    """(N, k) float64, one sample of each photon."""
    return np.atleast_2d(np.array(sampler(streams(**key)), np.float64)).T


def share_of_bins(density: Callable[[Any], Any], edges: F64) -> F64:
    """Integral over bins of cos(theta) of a density per steradian about an axis: 2 pi * Gauss-Legendre per bin."""
    x, w = np.polynomial.legendre.leggauss(16)
    half = np.diff(edges)[:, None] / 2
    nodes = (edges[:-1] + edges[1:])[:, None] / 2 + half * x
    value = np.array(density(mi.Float(nodes.ravel().astype(np.float32))), np.float64).reshape(nodes.shape)
    return np.asarray(2 * math.pi * (value * w * half).sum(axis=1))


def assert_lobe(direction: F64, axis: F64, density: Callable[[Any], Any], edges: F64, label: str) -> None:
    """Directions follow a rotationally symmetric density about `axis`: cos(theta) bins x 12 azimuth bins."""
    assert np.abs(np.linalg.norm(direction, axis=1) - 1).max() < 1e-5
    cosine, turn = azimuth(direction, axis)
    edges[-1] = 1.0
    counts, _, _ = np.histogram2d(np.clip(cosine, -1, 1), turn, bins=[edges, np.linspace(0, 1, 13)])
    expected = np.repeat(share_of_bins(density, edges)[:, None], 12, axis=1) / 12
    assert_chi_squared(counts, expected * len(direction), label)


def test_uniform_disc() -> None:
    xy = samples(sampling.uniform_disc)
    assert_uniform(np.column_stack([(xy**2).sum(axis=1), np.arctan2(*xy.T) / (2 * math.pi) % 1.0]), "disc")


def test_gaussian_disc() -> None:
    """The radius at which the irradiance has fallen to 1/e^2 is 1; P(r) = 1 - exp(-2 r^2)."""
    xy = samples(sampling.gaussian_disc)
    radial = -np.expm1(-2 * (xy**2).sum(axis=1))
    assert_uniform(np.column_stack([radial, np.arctan2(*xy.T) / (2 * math.pi) % 1.0]), "gaussian")


def test_exponential() -> None:
    assert_uniform(-np.expm1(-samples(sampling.exponential)), "exponential", bins=500)


def test_uniform_sphere() -> None:
    cosine, turn = azimuth(samples(sampling.uniform_sphere), AXIS)
    assert_uniform(np.column_stack([(1 + np.clip(cosine, -1, 1)) / 2, turn]), "sphere")


def test_cosine_hemisphere() -> None:
    """cos^2 is uniform under a density cos / pi."""
    direction = samples(sampling.cosine_hemisphere)
    cosine, turn = azimuth(direction, np.array([0.0, 0.0, 1.0]))
    assert cosine.min() >= 0
    assert_uniform(np.column_stack([cosine**2, turn]), "cosine")


@pytest.mark.parametrize("g", [-0.5, 0.0, 0.3, 0.75, 0.95])
def test_henyey_greenstein(g: float) -> None:
    """Also its mean cosine, which is g by definition."""
    direction = samples(lambda rng: sampling.henyey_greenstein(rng, mi.Vector3f(AXIS.tolist()), mi.Float(g)))
    edges = np.cos(np.linspace(math.pi, 0, 61))
    assert_lobe(direction, AXIS, lambda c: sampling.henyey_greenstein_pdf(c, mi.Float(g)), edges, f"g = {g}")
    cosine = direction @ AXIS
    assert_z((cosine.mean() - g) / (cosine.std() / math.sqrt(N)), f"mean cosine, g = {g}")


@pytest.mark.parametrize("kappa", [5.0, 100.0, 1000.0])
def test_von_mises_fisher(kappa: float) -> None:
    """Also its mean cosine, coth(kappa) - 1 / kappa."""
    direction = samples(lambda rng: sampling.von_mises_fisher(rng, mi.Vector3f(AXIS.tolist()), mi.Float(kappa)))
    edges = np.concatenate([[-1.0], 1.0 - np.geomspace(min(1.9, 14 / kappa), 1e-2 / kappa, 40), [1.0]])
    assert_lobe(direction, AXIS, lambda c: sampling.von_mises_fisher_pdf(c, mi.Float(kappa)), edges, f"kappa {kappa}")
    cosine = direction @ AXIS
    mean = 1 / math.tanh(kappa) - 1 / kappa
    assert_z((cosine.mean() - mean) / (cosine.std() / math.sqrt(N)), f"mean cosine, kappa = {kappa}")


def test_hat_barycentrics() -> None:
    """Density proportional to b0: b0 follows Beta(2, 2), b1 / (b1 + b2) is uniform and independent of it."""
    b = samples(sampling.hat_barycentrics)
    assert np.abs(b.sum(axis=1) - 1).max() < 1e-6
    cdf = b[:, 0] ** 2 * (3 - 2 * b[:, 0])
    assert_uniform(np.column_stack([cdf, b[:, 1] / np.maximum(b[:, 1] + b[:, 2], 1e-30)]), "hat")


def draws(count: int, **key: int) -> F64:
    """(N, count) successive uniform numbers of each photon."""
    rng = streams(**key)
    return np.stack([np.array(rng.next(), np.float64) for _ in range(count)], axis=1)


def test_streams_are_uniform() -> None:
    """Each of a photon's first draws is uniform over the photons, in 1000 bins and in its lowest bits."""
    for k, u in enumerate(draws(12).T):
        assert_uniform(u, f"draw {k}", bins=1000)
        assert_uniform((u * 2**15) % 1.0, f"lower bits of draw {k}", bins=128)


def test_successive_draws_are_independent() -> None:
    """Pairs at lags 1 to 4 and triples of a photon's successive draws fill square and cube evenly."""
    u = draws(10)
    for lag in range(1, 5):
        assert_uniform(np.column_stack([u[:, 0], u[:, lag]]), f"lag {lag}", bins=32)
        assert_uniform(np.column_stack([u[:, 4], u[:, 4 + lag]]), f"lag {lag} from the fifth", bins=32)
    assert_uniform(u[:, :3], "triples", bins=16)


@pytest.mark.parametrize(
    "other", [{"first": 1}, {"first": 2}, {"first": 256}, {"first": N}, {"stream": 3}, {"stream": 0}, {"seed": 2},
              {"seed": 0}, {"seed": 2, "stream": 1}], ids=str,
)  # fmt: skip
def test_streams_of_neighbours_are_independent(other: dict[str, int]) -> None:
    """Neighbouring photons, streams and seeds have nothing in common, at the same draw or at the next one."""
    u, v = draws(6), draws(6, **other)
    for k in range(4):
        for j in (k, k + 1):
            assert_uniform(np.column_stack([u[:, k], v[:, j]]), f"draws {k}, {j}", bins=32)
    correlation = [np.corrcoef(u[:, k], v[:, j])[0, 1] for k in range(6) for j in range(6)]
    assert_z(np.array(correlation) * math.sqrt(N), "correlation")


def test_a_stream_is_its_names_alone() -> None:
    """Photon i of a stream draws the same numbers wherever in an array it stands."""
    assert np.array_equal(draws(3, first=1000, n=50), draws(3, first=900, n=150)[100:])
