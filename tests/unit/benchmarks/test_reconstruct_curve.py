"""The reconstruction's curve: more spots, less error, by a rate."""

from __future__ import annotations

import numpy as np

from benchmarks import reconstruct


def test_the_completion_converges_with_spots() -> None:
    """Rationale: errors of independent samples fall as the root of their number; filling between spots is slower at
    first. Expected: on average over twice four times the spots, a rate of at least the fourth root.
    """
    error = [reconstruct.completion(2, spots)["error"] for spots in (15, 60, 240)]
    rate = np.log(error[0] / error[2]) / np.log(16)
    assert rate > 1 / 4
    assert error[2] < 0.02  # of a truth that spans more than two decades
