"""Error against time of the reconstruction methods, on a capture that all of them share.

Error: nrmse over all lights and held-out views (rms, signed); error_std: from the scores' standard errors, which come
from the references' noise alone. Time and memory: what the method took for reconstruction and relighting together.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from disco_twin.evaluate.summary import rms
from disco_twin.run.stages import begin_run, run_all

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "quick.toml"


def run(quick: bool = False) -> dict[str, Any]:
    """One curve a method, a point each."""
    with tempfile.TemporaryDirectory() as folder:
        opened = begin_run(SCENE, Path(folder) / "run", "small" if quick else "full", "all", Console(stderr=True))
        summary = run_all(opened)
        took = json.loads((opened.folder.work / "pipeline.json").read_text())["methods"]
    peaks = {row["name"]: row["peak_mb"] for row in summary["stages"]}
    curves = []
    for method in opened.methods:
        rows = [row for row in summary["relit"] if row["method"] == method]
        error = rms([row["nrmse"] for row in rows])
        variance = sum((row["nrmse"] * row["nrmse_se"] / max(abs(error), 1e-9) / len(rows)) ** 2 for row in rows)
        point = {
            "seconds": took[method]["seconds"],
            "peak_mb": peaks[f"reconstruct {method}"],
            "error": error,
            "error_std": float(np.sqrt(variance)),
            "settings": {"scene": summary["scene"], "profile": "small" if quick else "full"},
        }
        curves.append({"name": method, "points": [point]})
    return {"curves": curves}
