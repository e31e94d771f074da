"""The rows of an error budget, and what each part of the way costs by them.

Errors of parts act on each other, so what they cost need not add up in quadrature to the whole.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from disco_twin.evaluate import true_calibration
from disco_twin.evaluate.summary import rms
from hw.base.config import Strict
from pipeline.relight.scores import signed_root

# Rows of light, in the order of the way; the names are what the table shows.
EXACT_ENTRY = "exact entry, diffuse exit"
EXACT_EXIT = "diffuse entry, exact exit"
SMOOTH = "diffuse ends, smooth F_t"
FLOOR = "diffuse ends, best curve"
LUMPED = "exact entry, scan's hats (lumped)"
CONSISTENT = "exact entry, scan's hats (consistent)"
TRUE_MODEL = "true R_d on the scan's hats"
# Rows of the method and of the whole job; those of `true_calibration` beside them.
EXACT_SAMPLES = "exact samples, completed"
EXACT_SCAN, QUIET, MEASURED, NOMINAL = "scan without its error", "camera without noise", "as measured", "uncalibrated"


class Cost(NamedTuple):
    """What a part costs: the difference of the squares of two rows, with the part and without; None: of no error.

    within: it is a share of the part before it, and counts there
    """

    with_it: str
    without: str | None
    within: bool = False


COSTS = {
    "eq. 2.1 (diffuse ends)": Cost(FLOOR, None),
    "the scan's hats": Cost(TRUE_MODEL, FLOOR),
    "completion": Cost(EXACT_SAMPLES, TRUE_MODEL),
    "the scanner": Cost(MEASURED, EXACT_SCAN),
    "calibration": Cost(MEASURED, true_calibration.ALL),
    "- photometric": Cost(MEASURED, true_calibration.PHOTOMETRIC, within=True),
    "- poses": Cost(MEASURED, true_calibration.POSE, within=True),
    "- projector": Cost(MEASURED, true_calibration.PROJECTOR, within=True),
    "camera noise": Cost(MEASURED, QUIET),
}
LEFT = "what is left"

Images = Mapping[tuple[str, str], NDArray[np.floating]]  # (light, view) -> (2, L, H, W) halves, W/(mm^2 sr)


class BudgetRow(Strict):
    """One row of the budget under one light in one view; None where there is no score."""

    row: str
    light: str
    view: str
    nrmse: float | None
    nrmse_se: float | None


@dataclass(frozen=True)
class Budget:
    """rows: of everything that was made exact; left_out: what this run has no row for, and why."""

    rows: tuple[BudgetRow, ...]
    left_out: Mapping[str, str]

    def nrmse(self, row: str, light: str) -> float | None:
        """Views together; None where there is no score."""
        kept = [r.nrmse for r in self.rows if (r.row, r.light) == (row, light) and r.nrmse is not None]
        return rms(kept) if kept else None

    def cost(self, part: str, light: str) -> float | None:
        """Signed root of the difference of two rows' squares; of `LEFT`, what the parts leave of the whole. None where
        a row has no score.
        """
        if part == LEFT:
            whole, parts = self.nrmse(MEASURED, light), [self.cost(p, light) for p, c in COSTS.items() if not c.within]
            if whole is None:
                return None
            return signed_root(whole * abs(whole) - sum(p * abs(p) for p in parts if p is not None))
        cost = COSTS[part]
        more, less = self.nrmse(cost.with_it, light), 0.0 if cost.without is None else self.nrmse(cost.without, light)
        if more is None or less is None:
            return None
        return signed_root(more * abs(more) - less * abs(less))
