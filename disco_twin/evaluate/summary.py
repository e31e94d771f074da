"""summary.json: what a run did, as numbers that a program can read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from disco_twin.evaluate.simulation_noise import measured_noise
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.scene.scene import Scene
from pipeline.stream.stream import StreamReader

FORMAT_VERSION = 1


def make_summary(
    scene: Scene,
    folder: RunFolder,
    method: str,
    stages: Sequence[dict[str, Any]],
    scores: dict[str, Any],
    calibration: dict[str, Any],
    left_out: Sequence[dict[str, str]],
) -> dict[str, Any]:
    """The summary; `scores` as `disco_twin.evaluate.scores.score_run` wrote them, `calibration` as the pipeline did."""
    parts = ("measured", "completed", "coverage")
    own = scores["reflectance"].get(method, {part: {} for part in parts}) or dict.fromkeys(parts)
    with StreamReader(folder.capture) as stream:
        capture = {
            "images": len(stream),
            "views": stream.plan.views,
            "spots": len(stream.plan.spots),
            "wavelengths": len(scene.rig.lasers),
            "bytes_raw": stream.bytes_raw(),
            "bytes_stored": stream.bytes_stored,
        }
    return {
        "format_version": FORMAT_VERSION,
        "scene": scene.name,
        "seed": scene.seed,
        "method": method,
        "stages": list(stages),
        "capture": capture,
        "simulation_noise": measured_noise(scene, folder.twin / "responses"),
        "calibration": calibration,
        "relit": scores["relit"],
        "z": scores["z"].get(method),
        "reflectance": {
            "log10_rmse_by_decade": own["measured"],
            "log10_rmse_all_by_decade": own["completed"],
            "coverage_by_decade": own["coverage"],
            "totals": scores["totals"].get(method),
            "slopes": scores["slopes"].get(method),
        },
        "left_out": list(left_out),
    } | ({} if scores["neck"] is None else {"neck": scores["neck"]})


def rms(values: Sequence[float]) -> float:
    """Root mean square that keeps the sign of each value's square (nrmse may be negative within its noise)."""
    square = float(np.mean([v * abs(v) for v in values])) if values else float("nan")
    return float(np.copysign(abs(square) ** 0.5, square))


def pooled(relit: Sequence[Mapping[str, Any]], method: str, light: str | None = None, figure: str = "nrmse") -> float:
    """rms of a method's nrmse over the views, and over the lights unless one is given; NaN where there is no score."""
    rows = [r for r in relit if r["method"] == method and light in (None, r["light"])]
    return rms([float(r[figure]) for r in rows if r.get(figure) is not None])


def figure_or_dash(value: float | None) -> str:
    """Three digits, or a dash where there is no score."""
    return "-" if value is None or not np.isfinite(value) else f"{value:.3f}"
