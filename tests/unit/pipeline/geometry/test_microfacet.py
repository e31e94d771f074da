"""The reflection of a rough surface against what any BRDF of microfacets must hold."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry import microfacet
from pipeline.geometry.fresnel import mean_transmittance, transmittance
from pipeline.geometry.microfacet import ggx, reflected, rough_transmittance, smith


@pytest.mark.parametrize("alpha", [0.05, 0.2, 0.5, 1.0])
def test_the_facets_project_to_the_surface(alpha: float) -> None:
    """Rationale: facets of a height field cover the surface once (Walter et al. 2007, eq. 4): the exact value is 1.

    Seen obliquely, those shown cover what the surface covers (eq. 23 of Heitz 2014 for uncorrelated facets).
    """
    nodes, weights = np.polynomial.legendre.leggauss(400)
    t = 0.5 * (nodes + 1)
    c = 1 - t**4  # dense at the normal
    assert (0.5 * weights * 4 * t**3 * 2 * np.pi * ggx(c, alpha) * c).sum() == pytest.approx(1.0, abs=1e-5)
    azimuth = 2 * np.pi * (np.arange(512) + 0.5) / 512
    for cosine in (0.2, 0.6, 1.0):
        toward = c[:, None] * cosine + np.sqrt(1 - c**2)[:, None] * np.sqrt(1 - cosine**2) * np.cos(azimuth)
        covered = (np.maximum(toward, 0).mean(axis=1) * 0.5 * weights * 4 * t**3 * 2 * np.pi * ggx(c, alpha)).sum()
        assert smith(cosine, alpha) * covered == pytest.approx(cosine, rel=2e-3)


def test_swapped_directions_reflect_alike() -> None:
    a = reflected(np.array([0.9]), np.array([0.7]), np.array([0.8]), np.array([0.5]), 1.5, 0.3)
    b = reflected(np.array([0.9]), np.array([0.7]), np.array([0.5]), np.array([0.8]), 1.5, 0.3)
    assert a == b > 0


def test_a_nearly_smooth_surface_reflects_what_is_not_transmitted() -> None:
    """Rationale: under light from all sides a smooth dielectric reflects 1 - Tbar (Walsh 1926); facets of alpha .005
    do so to half a percent, which they lose at grazing incidence.
    """
    rng, n, eta, alpha = np.random.default_rng(0), 400_000, 1.5, 0.005
    cosine = np.sqrt(rng.random(n))  # Lambertian incidence
    incident = np.column_stack([np.sqrt(1 - cosine**2), np.zeros(n), cosine])
    u, v = rng.random((2, n))
    facet = np.sqrt((1 - u) / (1 + (alpha**2 - 1) * u))  # cosine of normals drawn by density times cosine (eq. 35)
    sine = np.sqrt(1 - facet**2)
    half = np.column_stack([sine * np.cos(2 * np.pi * v), sine * np.sin(2 * np.pi * v), facet])
    difference = (half * incident).sum(axis=1)
    out = 2 * difference[:, None] * half - incident
    ok = (difference > 0) & (out[:, 2] > 0)
    brdf = reflected(facet[ok], difference[ok], cosine[ok], out[ok, 2], eta, alpha)
    density = ggx(facet[ok], alpha) * facet[ok] / (4 * difference[ok])
    share = np.zeros(n)
    share[ok] = brdf * out[ok, 2] / density
    expected = 1 - mean_transmittance(eta)
    assert share.mean() == pytest.approx(expected, abs=4 * share.std() / n**0.5 + 0.005 * expected)


def test_hardly_rough_transmits_like_smooth() -> None:
    c = np.array([0.1, 0.3, 0.6, 1.0])
    np.testing.assert_allclose(rough_transmittance(c, 1.4, 0.003), transmittance(c, 1.4), rtol=2e-3)


def test_the_quadrature_converges(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rationale: the midpoint rule; with four times the points a side it is less than a third as far off."""
    c, value = np.array([0.1, 0.3, 0.7]), {}
    for n in (12, 48, 384):
        monkeypatch.setattr(microfacet, "FACETS", n)
        value[n] = rough_transmittance(c, 1.5, 0.3)
    coarse, fine = (np.abs(value[n] - value[384]).max() for n in (12, 48))
    assert fine < coarse / 3
    assert fine < 2e-3  # a tenth of what the fit takes a bin to be off by
