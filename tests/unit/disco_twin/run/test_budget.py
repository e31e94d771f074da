"""The error budget's bookkeeping; its rows are made in tests/system/test_budget.py."""

from __future__ import annotations

import numpy as np
import pytest
from significance import assert_z, z_of_replicates

from disco_twin.evaluate import true_calibration
from disco_twin.run.budget import rows
from disco_twin.run.budget.job_rows import Expectation, noise_per_signal
from disco_twin.run.budget.rows import COSTS, LEFT, Budget, BudgetRow


def made(**nrmse: float) -> Budget:
    """Rows of one light in two views, alike in both."""
    names = {"measured": rows.MEASURED, "floor": rows.FLOOR, "hats": rows.TRUE_MODEL, "samples": rows.EXACT_SAMPLES}
    names |= {"scan": rows.EXACT_SCAN, "quiet": rows.QUIET, "true": true_calibration.ALL, "pose": true_calibration.POSE}
    own = [
        BudgetRow(row=names[name], light="edge", view=view, nrmse=x, nrmse_se=0.001)
        for name, x in nrmse.items()
        for view in ("left", "right")
    ]
    return Budget(tuple(own), {})


def test_costs_are_differences_of_squares() -> None:
    """Expected: with parts that act on their own, the sums of squares close and nothing is left."""
    own = made(floor=0.3, hats=0.5, samples=0.5, scan=0.5, quiet=(0.5**2 + 0.1**2) ** 0.5, true=0.5, measured=0.6)
    assert own.cost("eq. 2.1 (diffuse ends)", "edge") == pytest.approx(0.3)
    assert own.cost("the scan's hats", "edge") == pytest.approx(0.4)
    assert own.cost("completion", "edge") == pytest.approx(0.0)
    assert own.cost("the scanner", "edge") == pytest.approx((0.6**2 - 0.5**2) ** 0.5)
    squares = sum((own.cost(part, "edge") or 0.0) ** 2 for part in COSTS)
    left = own.cost(LEFT, "edge")
    assert left is not None and left * abs(left) == pytest.approx(0.6**2 - squares)


def test_a_part_of_the_calibration_counts_within_it() -> None:
    own = made(floor=0.3, pose=0.4, true=0.4, measured=0.5)
    assert own.cost("- poses", "edge") == own.cost("calibration", "edge") == pytest.approx(0.3)
    assert own.cost(LEFT, "edge") == pytest.approx((0.5**2 - 2 * 0.3**2) ** 0.5)


def test_a_part_that_helps_costs_less_than_nothing_and_what_is_missing_costs_nothing() -> None:
    own = made(floor=0.3, hats=0.2, measured=0.4)
    assert own.cost("the scan's hats", "edge") == pytest.approx(-((0.3**2 - 0.2**2) ** 0.5))
    assert own.cost("the scanner", "edge") is None
    assert own.cost(LEFT, "edge") == pytest.approx((0.4**2 - 0.2**2) ** 0.5)
    assert made(floor=0.3).cost(LEFT, "edge") is None


def test_the_quiet_camera_draws_expectations() -> None:
    quiet = Expectation(np.random.default_rng(1), 0.5)
    assert quiet.poisson(3.7) == 3.7  # type: ignore[arg-type]
    drawn = quiet.standard_normal((1000,))
    assert np.abs(drawn).max() <= 0.25 and abs(drawn.mean()) < 0.02


def test_noise_of_exact_samples_does_not_favour_the_dark_ones() -> None:
    """Rationale: few photons, of which most replicates find none. Expected: weighed by what is known of their noise,
    samples have the mean of their expectation; weighed by their own spread, a lower one.
    """
    random = np.random.default_rng(1)
    distance = random.uniform(1.0, 30.0, (20, 400))
    expected = np.exp(-distance / 8)
    drawn = random.poisson(20 * expected, (16, 4, 1, 20, 400)) / 20
    value, variance = drawn.mean(axis=1), drawn.var(axis=1, ddof=1) / 4

    def weighed(weights: np.ndarray) -> np.ndarray:
        return np.asarray((weights * (value / expected - 1)).sum(axis=(1, 2, 3)) / weights.sum(axis=(1, 2, 3)))

    slope = np.stack([noise_per_signal(*one, distance) for one in zip(value, variance, strict=True)])
    assert_z(z_of_replicates(weighed(1 / (slope * expected + 1e-4))), "weighed by pooled noise")
    assert weighed(1 / (variance + 1e-4)).mean() < -0.1
    np.testing.assert_allclose(slope.mean(), 1 / 80, rtol=0.02)  # of four replicates, each of 20 photons a unit
