"""The figures of `benchmarks.accuracy` for the objects that constants may be chosen on: `scenes/accuracy/choose`."""

from __future__ import annotations

from typing import Any

from benchmarks.accuracy import RUNS, SCENES, report, set_of, shrunken

QUICK_OBJECT = "ring"  # what --quick runs, in the small profile


def run(quick: bool = False) -> dict[str, Any]:
    """The choosing set; `quick`: one object of it, shrunken, under two lights."""
    if quick:
        return shrunken(SCENES / "accuracy" / "choose" / f"{QUICK_OBJECT}.toml")
    return report(set_of("choose"), RUNS)
