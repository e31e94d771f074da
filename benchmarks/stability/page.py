"""`python -m benchmarks.stability.page FILE PAGE`: the stress suite's record as a page of the documentation."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

INTRODUCTION = """# Stability: every numerical kernel at the end of its range

Made by `make stability`. Each case has its right answer written down before it runs (`benchmarks/stability/`, a module
for each family): an error below a tolerance, or a refusal in one line. Errors are in the units of the tolerance beside
them: relative, counts of wrong values, or standard errors. Verdicts: *right*; *refused* in one line with its remedy;
*silently wrong*, which none may be; *crashed* and *hung*, likewise. A medium that is not fitted is refused with its
reason alone: the reconstruction goes on without one. Rivals answer the same question: the textbook's formula, the
baselines, stock Mitsuba.

Solvers report an outcome (`hw/base/outcome.py`: converged, stopped after so many steps, singular, out of range) with
its cause and remedy, and callers act on it: the fits of lenses and of the projector refuse anything but convergence;
the completion and the fit of R_d by distance go on where they are nearly there and refuse otherwise; a medium that does
not converge is left out with the reason; column totals stay as they were. Decision
[0195](decisions/0195-a-stress-suite.md) tells what was found.
"""


def page(record: dict[str, Any]) -> str:
    """The page. record: as `benchmarks.stability.run` makes it, with the common keys."""
    rows = record["cases"]
    counts = ", ".join(f"{n} {verdict}" for verdict, n in record["verdicts"].items())
    lines = [
        INTRODUCTION,
        f"{len(rows)} cases at commit {record['commit']}, in {record['seconds']:.0f} s on {record['cores']} cores: "
        f"{counts}; {record['not_as_expected']} not as expected.",
        "",
        "| rival | verdict | cases |",
        "|---|---|---|",
        *(f"| {r['rival']} | {r['verdict']} | {r['cases']} |" for r in record["rivals"]),
    ]
    for family in dict.fromkeys(row["family"] for row in rows):
        lines += [
            "",
            f"## {family}",
            "",
            "| case | range | expected | error (tolerance) | verdict | rivals |",
            "|---|---|---|---|---|---|",
        ]
        lines += [_line(row) for row in rows if row["family"] == family]
    return "\n".join(lines) + "\n"


def _line(row: dict[str, Any]) -> str:
    error = "-" if row["error"] is None else f"{row['error']:.2g} ({row['tolerance']:.2g})"
    rivals = "; ".join(
        f"{name}: {own['verdict']}" + ("" if own["error"] is None else f", {own['error']:.2g}")
        for name, own in row["rivals"].items()
    )
    cells = (row["case"], row["extent"], row["expected"], error, row["verdict"], rivals)
    return "| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |"


if __name__ == "__main__":
    source, target = map(Path, sys.argv[1:])
    target.write_text(page(json.loads(source.read_text())))
