"""The truth of a scene: columns of exitance per irradiance and their angular moments, computed a few at a time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from disco_twin.experiment.experiment import Experiment
from disco_twin.light.balance import EnergyBalance
from disco_twin.light.moments import Moments, copies_of_one_laser, moments
from disco_twin.light.truth import Truth, truth_columns
from disco_twin.object.mesh import hat_basis
from hw.base.arrays import I64
from pipeline.plan.spots import farthest_points

if TYPE_CHECKING:
    from pipeline.capture.loop import Progress

COLUMNS_AT_ONCE = 4  # between two reports of the progress
MOMENT_WALKS = 1 / 8  # of the truth's, a column: slopes are one for all columns


def true_exitance(experiment: Experiment, columns: Sequence[int] | I64, walks: int) -> Truth:
    """The truth from these scan vertices to all others, from `walks` photons a column. Needs the renderer.

    Raises: InputError as `hat_basis`.
    """
    basis = hat_basis(experiment.object.mesh, experiment.scan)
    return truth_columns(experiment.transport, basis, np.asarray(columns, np.int64), walks, experiment.seed("truth"))


def compute_truth(experiment: Experiment, folder: Path, progress: Progress) -> None:
    """Write truth.npz, the scene's columns of the truth, spread evenly over the surface, a few at a time; and
    moments.npz, the moments of the middle laser's light in the same columns.
    """
    points, work, parts = np.asarray(experiment.scan.vertices, float), experiment.scene.simulation, []
    columns = np.sort(farthest_points(points, np.ones(len(points)), work.truth_columns))
    for low in range(0, len(columns), COLUMNS_AT_ONCE):
        part = columns[low : low + COLUMNS_AT_ONCE]
        parts.append(true_exitance(experiment, part, work.truth_walks))
        progress(low + len(part), len(columns))
    _joined(parts).save(folder / "truth.npz")
    true_moments(experiment, columns, MOMENT_WALKS * work.truth_walks).save(folder / "moments.npz")


def true_moments(experiment: Experiment, columns: Sequence[int] | I64, walks: float) -> Moments:
    """The moments of the middle laser's light over the hats of these vertices. Needs the renderer.

    Raises: InputError as `hat_basis`.
    """
    from disco_twin.light.transport import Transport

    basis, laser = hat_basis(experiment.object.mesh, experiment.scan), len(experiment.scene.rig.lasers) // 2
    transport = Transport(copies_of_one_laser(experiment.object, laser))
    return moments(transport, basis, np.asarray(columns, np.int64), laser, round(walks), experiment.seed("moments"))


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
