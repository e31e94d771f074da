"""The figure of `disco-twin compare`: by how much the errors of one reconstruction are larger than those of another."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from disco_twin.evaluate.compare import Difference, by_stage
from disco_twin.report.figures import FAINT, INK, new_figure

WIDTH, ROW = 7.0, 0.16  # inches
REACH = 2.0  # standard errors that a bar shows
MOST = 300.0  # per cent; what is beyond stands at the edge


def write_differences(path: Path, differences: Sequence[Difference], first: str, second: str) -> None:
    """One row a figure, stage by stage: the difference in per cent of the first's error, with two standard errors.

    path: its ending says the format, as matplotlib knows them. Raises: OSError where it cannot be written.
    """
    rows = [
        d
        for own in by_stage(differences).values()
        for d in own
        if d.first and math.isfinite(d.first) and not math.isnan(d.difference)
    ]
    figure, axes = new_figure(WIDTH, 1.0 + ROW * max(len(rows), 1))
    at = np.arange(len(rows))
    per_cent = np.array([100 / abs(d.first) for d in rows])
    middle = np.clip(per_cent * [d.difference for d in rows], -MOST, MOST)
    axes.errorbar(middle, at, xerr=REACH * per_cent * [d.error for d in rows], fmt="o", color=INK, ms=3, lw=1)
    axes.axvline(0.0, color=FAINT, lw=1)
    axes.set_yticks(at, [d.figure for d in rows], fontsize=6)
    axes.invert_yaxis()
    axes.set_xlabel(f"error of {second} over that of {first}, %  (left: {second} is better)")
    figure.savefig(path)
