"""The lowest of tried costs: exact for a parabola, careful elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from hw.base.errors import DiscoError
from pipeline.calibrate.least_squares import likeliest


@pytest.mark.parametrize("at", [0.0, 0.13, -0.4])
def test_a_parabola_is_found_with_its_error(at: float) -> None:
    x = np.linspace(-1, 1, 9)
    found = likeliest(x, ((x - at) / 0.3) ** 2 + 5)
    assert found == pytest.approx((at, 0.3))


def test_an_end_has_the_error_of_its_rise() -> None:
    x = np.arange(5.0)
    assert likeliest(x, np.array([0.0, 5, 6, 6, 6])) == pytest.approx((0.0, 1 / np.sqrt(5)))
    assert likeliest(x, x[::-1] ** 2) == pytest.approx((4.0, 1.0))
    assert likeliest(x, np.zeros(5)) == (0.0, 4.0)


def test_costs_must_be_finite() -> None:
    with pytest.raises(DiscoError, match="not finite"):
        likeliest(np.arange(3.0), np.array([1.0, np.inf, 2.0]))
