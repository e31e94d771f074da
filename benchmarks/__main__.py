"""`python -m benchmarks NAME --json FILE [--quick]`: run a benchmark, show its figures, keep them as one JSON object.

A benchmark is a module with `run(quick: bool) -> dict`; what all have in common (commit, cores, seconds, peak memory)
is added here, but for keys that a benchmark writes itself.
"""

from __future__ import annotations

import argparse
import importlib
import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hw.base.resources import measured, usable_cores

REGISTRY = {
    "accuracy": "benchmarks.accuracy",
    "accuracy-choose": "benchmarks.accuracy_choose",
    "calibrate": "benchmarks.calibrate",
    "faults": "benchmarks.faults",
    "irradiance": "benchmarks.irradiance",
    "laser-safety": "benchmarks.laser_safety",
    "noise": "benchmarks.noise",
    "pace": "benchmarks.pace",
    "pareto": "benchmarks.pareto",
    "reconstruct": "benchmarks.reconstruct",
    "references": "benchmarks.references",
    "quick-figures": "benchmarks.quick_figures",
    "regression": "benchmarks.regression",
    "relight": "benchmarks.relight",
    "resample": "benchmarks.resample",
    "soak": "benchmarks.soak",
    "stability": "benchmarks.stability",
    "stream": "benchmarks.stream",
    "walk": "benchmarks.walk",
}


def main(arguments: list[str] | None = None) -> int:
    """Run one benchmark; exit status 2 for a name that does not exist."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Error against run time, and the like.")
    parser.add_argument("name", choices=sorted(REGISTRY))
    parser.add_argument("--json", type=Path, required=True, metavar="FILE", help="where the figures go")
    parser.add_argument("--quick", action="store_true", help="the same code on smaller sizes, in under a minute")
    options = parser.parse_args(arguments)
    module = importlib.import_module(REGISTRY[options.name])
    before = _cpu_seconds()
    with measured() as usage:
        figures: dict[str, Any] = module.run(quick=options.quick)
    record = {
        "format_version": 1,
        "name": options.name,
        "quick": options.quick,
        "commit": _commit(),
        "cores": usable_cores(),
        "cpu_over_wall": (_cpu_seconds() - before) / usage.seconds,
        "seconds": usage.seconds,
        "peak_mb": usage.peak_mb,
    }
    record |= figures
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n")
    for line in readable(record):
        print(line)
    return 0


def readable(record: dict[str, Any]) -> Iterator[str]:
    """A table: the plain figures, a line for every row of a list, for every object and method, for every point of a
    curve.
    """
    for key, value in record.items():
        if not isinstance(value, list | dict):
            yield f"{key:<24} {_short(value)}"
    for rows in (value for key, value in record.items() if isinstance(value, list) and key != "curves"):
        for row in rows:
            yield "  ".join(f"{name} {_short(value)}" for name, value in row.items())
    for name, methods in record.get("objects", {}).items():
        for method, lights in methods.items():
            yield f"{name:<10} {method:<11} " + "  ".join(f"{light} {_short(x)}" for light, x in lights.items())
    for curve in record.get("curves", []):
        for point in curve["points"]:
            settings = ", ".join(f"{k} {v}" for k, v in point.get("settings", {}).items())
            yield f"{curve['name']:<24} {point['seconds']:9.3f} s   error {point['error']:.3g}   {settings}"


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _cpu_seconds() -> float:
    """Seconds of all cores, children included."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in both)


def _commit() -> str:
    """The checkout's commit, with + when it has been changed since; unknown outside a checkout."""
    here = Path(__file__).resolve().parent

    def git(*words: str) -> str:
        return subprocess.run(["git", "-C", str(here), *words], capture_output=True, text=True, check=True).stdout

    try:
        return git("rev-parse", "--short", "HEAD").strip() + ("+" if git("status", "--porcelain").strip() else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


if __name__ == "__main__":
    sys.exit(main())
