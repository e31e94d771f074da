"""The boundary's curve from what views see of it, bin by bin."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hw.base.outcome import Ended, Outcome
from pipeline.calibrate import least_squares
from pipeline.calibrate.least_squares import Linearised
from pipeline.geometry.fresnel import transmittance
from pipeline.geometry.microfacet import rough_transmittance
from pipeline.reconstruct.global_term import boundary_fit
from pipeline.reconstruct.global_term.boundary_fit import EDGES, rough_boundary

MIDDLE = 0.5 * (EDGES[1:] + EDGES[:-1])[2:]


def seen(alpha: float, eta: float) -> np.ndarray:
    """Of a surface, over what the smooth one of index 1.3 transmits."""
    return rough_transmittance(MIDDLE, eta, alpha) / transmittance(MIDDLE, 1.3)


@pytest.mark.parametrize(("alpha", "eta"), [(0.1, 1.3), (0.3, 1.3), (0.3, 1.6), (0.5, 1.45)])
def test_the_curve_of_a_rough_surface_is_found(alpha: float, eta: float) -> None:
    """Expected: within a bin's error and a half where there are bins; within a third (two errors of normals) down to a
    cosine of .05, below all bins: a curve of bins alone would be constant there.
    """
    rng = np.random.default_rng(0)
    slope = np.gradient(np.log(transmittance(np.linspace(0.001, 1, 1000), 1.3)), np.linspace(0.001, 1, 1000))
    sigma = np.hypot(0.01, 0.03 * np.sqrt(1 - MIDDLE**2) * np.interp(MIDDLE, np.linspace(0.001, 1, 1000), slope))
    for _ in range(5):
        found = rough_boundary(1.3, MIDDLE, seen(alpha, eta) * np.exp(sigma * rng.standard_normal(len(MIDDLE))))
        at = np.interp(MIDDLE, found.cosines, found.ratio)
        np.testing.assert_allclose(at[MIDDLE > 0.3], seen(alpha, eta)[MIDDLE > 0.3], rtol=0.03)
        low = np.array([0.05, 0.1])
        true = rough_transmittance(low, eta, alpha) / transmittance(low, 1.3)
        np.testing.assert_allclose(np.interp(low, found.cosines, found.ratio), true, rtol=0.34)


def test_what_no_surface_does_is_not_believed() -> None:
    """Rationale: light that hats smear around an edge showed up as twice the transmittance at a cosine of .2."""
    wrong = seen(0.1, 1.3) * np.where(MIDDLE < 0.3, 1.8, 1.0)
    found = rough_boundary(1.3, MIDDLE, wrong)
    assert np.interp(0.2, found.cosines, found.ratio) < 1.4
    np.testing.assert_allclose(np.interp(0.7, found.cosines, found.ratio), 1.0, atol=0.05)


@pytest.mark.parametrize("alpha", [0.0, 0.02, 0.05])
def test_a_nearly_smooth_surface_is_not_made_rough(alpha: float) -> None:
    """Rationale: bins without noise of a surface that the prior does not expect. Expected: within a tenth where most
    pixels are, within a quarter at a cosine of .1, which a normal's error of 2 degrees explains.
    """
    exact = np.ones(len(MIDDLE)) if alpha == 0 else seen(alpha, 1.3)
    found = rough_boundary(1.3, MIDDLE, exact)
    np.testing.assert_allclose(np.interp(MIDDLE, found.cosines, found.ratio)[1:], exact[1:], rtol=0.1)
    own = 1.0 if alpha == 0 else float(rough_transmittance(np.array([0.1]), 1.3, alpha)[0] / transmittance(0.1, 1.3))
    assert np.interp(0.1, found.cosines, found.ratio) / own < 1.25


def test_levels_pass_through() -> None:
    plain, twice = (rough_boundary(1.3, MIDDLE, k * seen(0.3, 1.3)) for k in (1.0, 2.0))
    np.testing.assert_allclose(np.array(twice.ratio), 2.0 * np.array(plain.ratio), rtol=1e-4)


def test_a_matched_boundary_and_too_few_bins_stay_smooth() -> None:
    assert rough_boundary(1.0, MIDDLE, np.ones(len(MIDDLE))).ratio == (1.0,)
    assert rough_boundary(1.3, MIDDLE[:2], np.ones(2)).ratio == (1.0,)


@pytest.mark.parametrize("lost", [lambda k: k % 2 == 1, lambda k: True])
def test_roughnesses_that_no_fit_was_found_for_do_not_count(
    lost: Callable[[int], bool], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Rationale: every second fit stopped, beside the likeliest roughness; and all of them."""
    calls, stopped = itertools.count(), Ended(Outcome.STOPPED, 9)

    def minimise(*given: Any, **settings: Any) -> Linearised:
        found = least_squares.minimise(*given, **settings)
        k = next(calls)
        return replace(found, ended=stopped) if k < len(boundary_fit.ALPHAS) and lost(k) else found

    monkeypatch.setattr(boundary_fit, "minimise", minimise)
    found = rough_boundary(1.3, MIDDLE, seen(0.3, 1.3))
    if lost(0):
        assert set(found.ratio) == {1.0}
        assert "taken as smooth" in caplog.text
    else:
        np.testing.assert_allclose(np.interp(MIDDLE, found.cosines, found.ratio)[2:], seen(0.3, 1.3)[2:], rtol=0.05)
