"""Scores of entries whose error is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from disco_twin.evaluate.entries import score_entries
from pipeline.relight.scores import Unscorable

F64 = NDArray[np.float64]


def impulse(rng: np.random.Generator) -> F64:
    return np.asarray(10 ** rng.uniform(-4, 0, (3, 40, 200)))


def test_error_of_a_known_factor_in_every_decade() -> None:
    truth = impulse(np.random.default_rng(5))
    scores = score_entries(truth * 10**0.2, truth, 0 * truth, True)
    assert [s.decade for s in scores] == [0, -1, -2, -3]
    for s in scores:
        assert s.log10_rmse == pytest.approx(0.2)
        assert s.coverage == 1
        assert s.entries == pytest.approx(6000, rel=0.1)


def test_not_positive_is_one_decade_off_and_uncovered_is_only_counted() -> None:
    truth = impulse(np.random.default_rng(6))
    covered = np.arange(200) % 2 == 0
    scores = score_entries(np.where(covered, -1.0, truth), truth, 0 * truth, covered)
    for s in scores:
        assert s.log10_rmse == pytest.approx(1)
        assert s.coverage == pytest.approx(0.5, abs=0.03)
    assert score_entries(truth, truth, 0 * truth, False)[0].log10_rmse is None


def test_noise_of_the_truth_is_removed() -> None:
    """Expected: errors of .1 (log10) come out as .1 although the truth itself is known to 10 % only."""
    rng = np.random.default_rng(7)
    truth = impulse(rng)
    estimate = truth * 10 ** (0.1 * rng.normal(0, 1, truth.shape))
    scores = score_entries(estimate, truth * (1 + 0.1 * rng.normal(0, 1, truth.shape)), 0.1 * truth, True)
    for s in scores:
        assert s.log10_rmse is not None
        # The variance of 6000 squares of deviates of .1: .01 sqrt(2/6000) = 1.8e-4, four of them allowed.
        assert s.log10_rmse**2 == pytest.approx(0.01, abs=8e-4)


def test_entries_that_the_truth_does_not_know_are_left_out() -> None:
    truth = impulse(np.random.default_rng(8))
    se = np.where(truth < 0.1, truth, 0.01 * truth)
    scores = score_entries(truth, truth, se, True)
    assert scores[0].entries > 5000
    assert sum(s.entries for s in scores[1:]) < 300  # the peak is a little below 1


def test_a_truth_that_is_not_known_is_refused() -> None:
    ones = np.ones((3, 4, 5))
    with pytest.raises(Unscorable, match="half"):
        score_entries(ones, ones, ones, True)
