"""The tables on the terminal: scores, what each part of the calibration costs, the quality of a capture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rich.table import Table

from disco_twin.evaluate.summary import figure_or_dash, pooled
from pipeline.capture.quality import ViewQuality

if TYPE_CHECKING:
    from disco_twin.evaluate.compare import Difference
    from disco_twin.run.budget.rows import Budget

QUALITY = ("view", "camera", "deg", "images", "saturated", "lit", "range", "dark", "mW")


def score_table(summary: dict[str, Any]) -> Table:
    """nrmse by light and method, the one under test first."""
    relit = summary["relit"]
    methods = list(dict.fromkeys(row["method"] for row in relit))
    table = _table(("nrmse", *methods), "nrmse")
    for light in dict.fromkeys(r["light"] for r in relit):
        table.add_row(light, *(figure_or_dash(pooled(relit, method, light)) for method in methods))
    return table


def budget_tables(budget: Budget) -> tuple[Table, Table]:
    """nrmse of every row, views together, and what each part costs, by light."""
    from disco_twin.run.budget.rows import COSTS, LEFT

    lights = list(dict.fromkeys(row.light for row in budget.rows))
    made, costs = (_table((name, *lights), name) for name in ("nrmse with", "what costs"))
    for row in dict.fromkeys(row.row for row in budget.rows):
        made.add_row(row, *(figure_or_dash(budget.nrmse(row, light)) for light in lights))
    for part in (*COSTS, LEFT):
        costs.add_row(part, *(figure_or_dash(budget.cost(part, light)) for light in lights))
    return made, costs


def difference_table(differences: Sequence[Difference], first: str, second: str) -> Table:
    """A row for every figure; what is called better or worse is so beyond chance, all rows together."""
    from disco_twin.evaluate.compare import worse

    table = _table(("error", first, second, "by", "+-", ""), "error", no_wrap=True)
    later, sooner = ({d.figure for d in worse(rows)} for rows in (differences, [d.swapped for d in differences]))
    for d in differences:
        verdict = "worse" if d.figure in later else "better" if d.figure in sooner else ""
        error = "exact" if d.error == 0 else "?" if math.isnan(d.error) else f"{d.error:.2g}"
        table.add_row(d.figure, f"{d.first:.4g}", f"{d.second:.4g}", f"{d.difference:+.2g}", error, verdict)
    return table


def quality_table(views: Sequence[ViewQuality]) -> Table:
    """A row for every view."""
    table = _table(QUALITY, "camera", no_wrap=True)
    for v in views:
        table.add_row(
            str(v.view),
            v.camera,
            f"{math.degrees(v.angle_rad):.1f}",
            f"{v.stored}/{v.planned}",
            f"{100 * v.saturated:.2f} %",
            f"{100 * v.significant:.1f} %",
            f"{v.range_db:.0f} dB" if v.stored else "-",
            f"{v.dark}/{v.spots}",
            " ".join("-" if math.isnan(p) else f"{1e3 * p:.2f}" for p in v.power_w),
        )
    return table


def _table(names: Sequence[str], left: str, no_wrap: bool = False) -> Table:
    """Columns of figures, and one of names, which starts at the left."""
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in names:
        table.add_column(name, justify="left" if name == left else "right", no_wrap=no_wrap)
    return table
