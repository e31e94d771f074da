"""The truth of a scene: columns of exitance per irradiance, computed a few at a time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from disco_twin.experiment.experiment import Experiment
from disco_twin.light.balance import EnergyBalance
from disco_twin.light.truth import Truth, truth_columns
from disco_twin.object.mesh import hat_basis
from hw.base.arrays import I64
from pipeline.plan.spots import farthest_points

if TYPE_CHECKING:
    from pipeline.capture.loop import Progress

COLUMNS_AT_ONCE = 4  # between two reports of the progress


def true_exitance(experiment: Experiment, columns: Sequence[int] | I64, walks: int) -> Truth:
    """The truth from these scan vertices to all others, from `walks` photons a column. Needs the renderer.

    Raises: InputError as `hat_basis`.
    """
    basis = hat_basis(experiment.object.mesh, experiment.scan)
    return truth_columns(experiment.transport, basis, np.asarray(columns, np.int64), walks, experiment.seed("truth"))


def compute_truth(experiment: Experiment, path: Path, progress: Progress) -> None:
    """Write the scene's columns of the truth, spread evenly over the surface, a few at a time."""
    points, work, parts = np.asarray(experiment.scan.vertices, float), experiment.scene.simulation, []
    columns = np.sort(farthest_points(points, np.ones(len(points)), work.truth_columns))
    for low in range(0, len(columns), COLUMNS_AT_ONCE):
        part = columns[low : low + COLUMNS_AT_ONCE]
        parts.append(true_exitance(experiment, part, work.truth_walks))
        progress(low + len(part), len(columns))
    _joined(parts).save(path)


def _joined(parts: Sequence[Truth]) -> Truth:
    """Truth of several sets of columns as one; the balance is the mean over columns."""
    weights = [len(p.columns) for p in parts]
    names = EnergyBalance.__dataclass_fields__
    mean = {k: np.average([getattr(p.balance, k) for p in parts], axis=0, weights=weights) for k in names}
    return Truth(
        np.concatenate([p.columns for p in parts]),
        np.concatenate([p.replicates for p in parts], axis=2),
        parts[0].area,
        EnergyBalance(**mean),
    )
