"""The error budget's bookkeeping; what its rows render is in tests/validation/test_exact_light.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from refusals import Says

from disco_twin.run import budget
from disco_twin.run.budget import COSTS, LEFT, Budget, BudgetRow
from disco_twin.run.budget import _Expectation as Expectation


def made(**nrmse: float) -> Budget:
    """Rows of one light in two views, alike in both."""
    names = {"measured": budget.MEASURED, "floor": budget.FLOOR, "hats": budget.TRUE_MODEL}
    names |= {"samples": budget.EXACT_SAMPLES, "scan": budget.EXACT_SCAN, "quiet": budget.QUIET, "true": "all true"}
    rows = [
        BudgetRow(row=names[name], light="edge", view=view, nrmse=x, nrmse_se=0.001)
        for name, x in nrmse.items()
        for view in ("left", "right")
    ]
    return Budget(tuple(rows), {})


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


def test_a_run_that_is_not_finished_has_no_budget(tmp_path: Path, says: Says) -> None:
    assert "is no run folder" in says("budget", tmp_path)
