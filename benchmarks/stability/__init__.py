"""The stress suite: every numerical kernel at the end of its range, with its right answer written down beforehand.

`python -m benchmarks stability --json FILE` runs it all; `python -m benchmarks.stability.page` makes docs/stability.md
of the file. A family is a module with a `FAMILY`; what it is asked of this program it may ask of rivals, too.
"""

from __future__ import annotations

import importlib
from collections import Counter
from typing import Any

from benchmarks.stability.case import Case, Verdict

FAMILIES = (
    "camera",
    "poses",
    "surface",
    "solvers",
    "calibration",
    "completion",
    "diffusion",
    "meshes",
    "files",
    "relighting",
    "media",
    "light",
)


def cases(slow: bool) -> list[Case]:
    """All cases, in the order of the table; slow: also those that take more than a moment."""
    families = (importlib.import_module(f"benchmarks.stability.{name}").FAMILY for name in FAMILIES)
    return [case for family in families for case in family.cases if slow or not case.slow]


def run(quick: bool = False) -> dict[str, Any]:
    """`cases`: a row each; `verdicts`: how many ended how; `not_as_expected`, `silently_wrong`, `crashed`: numbers."""
    rows = [case.row() for case in cases(slow=not quick)]
    rivals = Counter((name, own["verdict"]) for row in rows for name, own in row["rivals"].items())
    return {
        "verdicts": dict(Counter(row["verdict"] for row in rows)),
        "not_as_expected": sum(not row["as_expected"] for row in rows),
        "silently_wrong": sum(row["verdict"] == Verdict.WRONG for row in rows),
        "rivals": [{"rival": name, "verdict": verdict, "cases": n} for (name, verdict), n in sorted(rivals.items())],
        "cases": rows,
    }
