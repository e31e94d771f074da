"""`python -m benchmarks NAME --json FILE [--quick]`: run a benchmark and keep its figures as JSON."""

from __future__ import annotations

import argparse
import importlib
import json
import platform
import sys
from pathlib import Path
from typing import Any

from disco_twin.resources import measured, total_memory_gb, usable_cores

# name -> module with `run(quick: bool) -> dict`; imported only when it is asked for.
REGISTRY = {
    "irradiance": "benchmarks.irradiance",
    "pareto": "benchmarks.pareto",
}


def main(arguments: list[str] | None = None) -> int:
    """Run one benchmark; exit status 2 for a name that does not exist."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("name", choices=sorted(REGISTRY))
    parser.add_argument("--json", type=Path, required=True, metavar="FILE", help="where the figures go")
    parser.add_argument("--quick", action="store_true", help="smaller: shows that it works, its figures mean little")
    options = parser.parse_args(arguments)
    module = importlib.import_module(REGISTRY[options.name])
    with measured() as usage:
        figures: dict[str, Any] = module.run(quick=options.quick)
    record = {
        "format_version": 1,
        "benchmark": options.name,
        "quick": options.quick,
        "machine": {
            "cores": usable_cores(),
            "memory_gb": round(total_memory_gb(), 1),
            "processor": platform.machine(),
            "python": platform.python_version(),
        },
        "seconds": usage.seconds,
        "peak_mb": usage.peak_mb,
        "figures": figures,
    }
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps(record, indent=1) + "\n")
    print(f"{options.name}: {usage.seconds:.1f} s, figures in {options.json}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
