"""What a pipeline made of a frozen capture: what figures are made from, and how far these move by rounding."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from disco_twin.evaluate.stage_figures import StageOutputs
from hw.base.files import load_arrays, save_arrays
from pipeline.calibrate.calibration import Calibration
from pipeline.reconstruct.samples.spots import Spots

FORMAT_VERSION = 1
REMEDY = "python -m benchmarks.frozen store"


def save_scores(
    path: Path, outputs: StageOutputs, columns: np.ndarray, vertices: int, slack: Mapping[str, float]
) -> None:
    """columns: the vertices whose truth is known: samples are kept there alone; slack: by figure."""
    arrays = {f"spots.{f.name}": np.asarray(getattr(outputs.spots, f.name)) for f in fields(Spots)}
    arrays |= {f"image.{light}@{view}": np.asarray(x, np.float32) for (light, view), x in outputs.images.items()}
    arrays["values"] = outputs.values[:, :, columns]
    arrays |= {"columns": columns, "lit": outputs.lit}
    if outputs.exitance is not None:
        arrays["exitance"] = outputs.exitance
    calibration = outputs.calibration.model_dump(mode="json")
    save_arrays(path, FORMAT_VERSION, arrays, calibration=calibration, vertices=vertices, slack=dict(slack))


def load_scores(path: Path) -> tuple[StageOutputs, dict[str, float]]:
    """Outputs and slack that `save_scores` wrote. Raises: InputError where the file is missing or damaged."""
    head, arrays = load_arrays(path, FORMAT_VERSION, REMEDY)
    some = arrays["values"]
    values = np.full((*some.shape[:2], head["vertices"]), np.nan)
    values[:, :, arrays["columns"]] = some
    names = [(name, *name.removeprefix("image.").split("@")) for name in arrays if name.startswith("image.")]
    spots: dict[str, Any] = {f.name: arrays[f"spots.{f.name}"] for f in fields(Spots)}
    spots["beam_radius"] = float(spots["beam_radius"])
    exitance = arrays.get("exitance")
    outputs = StageOutputs(
        Calibration.model_validate(head["calibration"]),
        Spots(**spots),
        values,
        exitance,
        arrays["lit"],
        {(light, view): arrays[name] for name, light, view in names},
    )
    return outputs, head["slack"]
