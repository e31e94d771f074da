"""Fresnel factors against the textbook amplitudes, closed-form values and quadrature."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

from pipeline.geometry.fresnel import Boundary, mean_transmittance, transmittance


def textbook(cosine: float, eta: float) -> float:
    """1 - (r_s^2 + r_p^2) / 2 by Snell's law in angles."""
    outside = np.arccos(cosine)
    inside = np.arcsin(np.sin(outside) / eta)
    rs = np.sin(outside - inside) / np.sin(outside + inside)
    rp = np.tan(outside - inside) / np.tan(outside + inside)
    return float(1 - (rs**2 + rp**2) / 2)


@pytest.mark.parametrize("eta", [1.05, 1.3, 1.5, 2.5])
def test_transmittance_is_the_textbooks(eta: float) -> None:
    for cosine in (1e-3, 0.05, 0.3, 0.7, 0.99):
        assert transmittance(cosine, eta) == pytest.approx(textbook(cosine, eta), rel=1e-9)


def test_extreme_cases() -> None:
    assert transmittance(1.0, 1.3) == pytest.approx(1 - (0.3 / 2.3) ** 2, rel=1e-14)  # normal incidence
    brewster = np.cos(np.arctan(1.5))
    rs = (1.5**2 - 1) / (1.5**2 + 1)  # all of the reflection is perpendicular there
    assert transmittance(brewster, 1.5) == pytest.approx(1 - rs**2 / 2, rel=1e-13)
    np.testing.assert_array_equal(transmittance([0.0, -0.5, -1.0], 1.3), 0)
    np.testing.assert_allclose(transmittance([1e-12, 0.2, 1.0], 1.0), 1, rtol=1e-12)
    # grazing: T = 2 cos (1 + eta^2) / sqrt(eta^2 - 1) to first order, with all its digits
    grazing = 2 * 1e-12 * (1 + 1.3**2) / np.sqrt(1.3**2 - 1)
    assert transmittance(1e-12, 1.3) == pytest.approx(grazing, rel=1e-9)
    with pytest.raises(ValueError, match="thinner"):
        transmittance(0.5, 0.9)


@pytest.mark.parametrize("eta", [1.0, 1.00002, 1.001, 1.3, 1.5, 3.0])
def test_hemispherical_mean(eta: float) -> None:
    def flux(cosine: float) -> float:
        return 2 * cosine * float(transmittance(cosine, eta))

    pieces = [quad(flux, a, b, epsabs=1e-13)[0] for a, b in ((0, 1e-4), (1e-4, 1e-2), (1e-2, 0.2), (0.2, 1))]
    assert mean_transmittance(eta) == pytest.approx(sum(pieces), abs=1e-7)


def test_published_mean() -> None:
    assert mean_transmittance(1.3) == pytest.approx(0.939, abs=5e-4)
    assert 1 - mean_transmittance(1.5) == pytest.approx(0.0918, abs=5e-5)  # Egan & Hilgeman 1979


@pytest.mark.parametrize("eta", [1.0, 1.00002, 1.001, 1.3, 1.5, 3.0])
def test_mean_of_a_measured_boundary(eta: float) -> None:
    """Rationale: scipy's adaptive quadrature of the same integrand, piece by piece between the ratio's corners."""
    boundary = Boundary(eta, (0.025, 0.075, 0.3, 0.8, 0.95), (3.7, 1.87, 0.6, 1.2, 0.9))

    def flux(cosine: float) -> float:
        return 2 * cosine * float(transmittance(cosine, boundary))

    ends = (0, 1e-4, 1e-2, *boundary.cosines, 1)
    exact = sum(quad(flux, a, b, epsabs=1e-13)[0] for a, b in pairwise(ends))
    assert boundary.mean_transmittance == pytest.approx(exact, abs=2e-8 if eta < 1.001 else 1e-10)  # closed form's own
    assert Boundary(eta).mean_transmittance == mean_transmittance(eta)
    assert Boundary(eta, (0.5,), (1.1,)).mean_transmittance == pytest.approx(1.1 * mean_transmittance(eta), rel=1e-14)
