"""The limits that a run's figures are held to."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.quick_figures import FALSE_ALARMS, Limit, bounds, false_alarms, make_limits, too_large

FIGURES = {"pose/a": 2.0, "relit/b": -0.5}


def captures(rng: np.random.Generator, count: int) -> list[dict[str, float]]:
    """Figures that scatter by a tenth."""
    return [{name: value * (1 + 0.1 * rng.standard_normal()) for name, value in FIGURES.items()} for _ in range(count)]


def test_one_more_capture_is_refused_as_rarely_as_the_bound_says() -> None:
    """Rationale: ten captures make the bound, an eleventh is judged, three thousand times."""
    rng, refused = np.random.default_rng(0), 0
    for _ in range(3000):
        bound = bounds(captures(rng, 10))
        refused += any(abs(value) > bound[name] for name, value in captures(rng, 1)[0].items())
    assert refused <= 3000 * FALSE_ALARMS + 4 * np.sqrt(3000 * FALSE_ALARMS)
    assert refused >= 5  # nor is it so wide that nothing ever is


def test_an_error_is_too_large_beyond_its_limit_whatever_its_sign() -> None:
    limits = {name: Limit(value, 0.0, 0.02 * abs(value), 2 * abs(value), 2.0) for name, value in FIGURES.items()}
    assert not too_large(FIGURES, limits, True)
    assert not too_large({name: 0.1 * value for name, value in FIGURES.items()}, limits, True)
    assert set(too_large({name: 1.1 * value for name, value in FIGURES.items()}, limits, True)) == set(FIGURES)
    assert not too_large({name: 1.1 * value for name, value in FIGURES.items()}, limits, False)
    assert set(too_large({"pose/a": 4.1, "relit/b": 1.1}, limits, False)) == set(FIGURES)
    assert set(too_large({"pose/a": float("nan"), "relit/b": -0.5}, limits, False)) == {"pose/a"}
    assert set(too_large({"pose/a": 0.0}, limits, True)) == {"relit/b"}  # what is not there is too large
    assert not too_large({"pose/a": 0.0}, limits, True, partly=True)


def test_limits_cover_what_kernels_do_and_refuse_what_would_hide_a_tenth() -> None:
    fresh = captures(np.random.default_rng(1), 10)
    limits = make_limits(FIGURES, [{"pose/a": 2.001, "relit/b": -0.5}], fresh)
    assert limits["pose/a"].tolerance == pytest.approx(max(0.02, 10 * 0.001))
    assert limits["relit/b"].tolerance == pytest.approx(0.005)
    assert limits["pose/a"].caught_from > 1.1
    assert not any(false_alarms([{"pose/a": 2.001, "relit/b": -0.5}], fresh, limits))
    with pytest.raises(ValueError, match="kernels"):
        make_limits(FIGURES, [{"pose/a": 2.05, "relit/b": -0.5}], fresh)
