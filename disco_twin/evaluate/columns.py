"""What models state of the truth's columns, scored: entries, totals, light across the neck, slopes, z-scores."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from disco_twin.evaluate.entries import score_entries
from disco_twin.evaluate.neck import score_neck
from disco_twin.evaluate.slopes import score_slopes, stated_slopes, true_slopes
from disco_twin.evaluate.totals import lit_vertices, score_totals
from disco_twin.evaluate.z_scores import Array, z_of_entries, z_of_totals
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.light.moments import Moments
from disco_twin.light.truth import Truth
from hw.base.arrays import Bool
from pipeline.model.relightable import RelightableModel
from pipeline.model.term import ReflectanceColumns
from pipeline.reconstruct.samples.samples_file import load_samples
from pipeline.relight.scores import Unscorable

log = logging.getLogger(__name__)


def score_columns(
    experiment: Experiment, folder: RunFolder, models: Mapping[str, Callable[[], RelightableModel]]
) -> dict[str, Any]:
    """Tbar^2 R_d against exitance per irradiance, of models given how to get them.

    reflectance: by method, log10_rmse of `measured` and of all entries (`completed`), and `coverage`, each by decade
        below the peak. A method that cannot be scored has None; one whose model states no R_d is left out.
    totals: by method, the scores of column totals over `lit` vertices, which have a spot in their triangles, and
        `unlit` ones (`TotalsScore`); a method whose model states none is left out.
    slopes: by method, of the angular term by distance (`score_slopes`) of the laser whose moments the truth has; a
        method without R_d is left out.
    neck: `score_neck` of all that state what leaves; None where the scene has no neck
    z: by method, of `entries` by decade, of `totals` and of `slopes` (`ZScores`); a method that states no variance is
        left out.

    Raises: InputError where the truth or the samples cannot be read.
    """
    truth = Truth.load(folder.twin / "truth.npz")
    lit = lit_vertices(load_samples(folder.work / "samples.npz"))[truth.columns]
    own_moments = Moments.load(folder.twin / "moments.npz")
    points = np.asarray(experiment.scan.vertices, np.float64)
    distance, true = true_slopes(own_moments, points, _edge(experiment), experiment.object.boundary)
    reflectance: dict[str, Any] = {}
    totals: dict[str, Any] = {}
    slopes: dict[str, Any] = {}
    z: dict[str, Any] = {}
    leaving: dict[str, Any] = {}
    for method, load in models.items():
        model = load()
        if (estimate := model.exitance_columns(truth.columns)) is not None:
            reflectance[method] = _decades(method, estimate, truth)
            if estimate.variance is not None and reflectance[method] is not None:
                z[method] = _z(estimate.mean, estimate.variance, truth, lit)
        if (stated := stated_slopes(model, int(own_moments.laser), distance)) is not None:
            slopes[method], together = score_slopes(stated, distance, true)
            if method in z:
                z[method]["slopes"] = asdict(together)
        if (out := model.leaving(truth.columns, truth.area)) is not None:
            leaving[method] = out
            totals[method] = {
                name: asdict(score_totals(out.sum(axis=2), truth, chosen))
                for name, chosen in (("lit", lit), ("unlit", ~lit))
            }
    beyond = experiment.beyond_neck
    neck = None if beyond is None else score_neck(leaving, truth, beyond)
    return {"reflectance": reflectance, "totals": totals, "slopes": slopes, "neck": neck, "z": z}


def _edge(experiment: Experiment) -> float:
    """Mean edge of the scan, mm."""
    return float(experiment.scan.edges_unique_length.mean())


def _decades(method: str, estimate: ReflectanceColumns, truth: Truth) -> dict[str, dict[str, float | None]] | None:
    try:
        own = score_entries(estimate.mean, truth.mean, truth.standard_error, estimate.measured)
        full = score_entries(estimate.mean, truth.mean, truth.standard_error, True)
    except Unscorable as why:
        log.warning("no score for the R_d of %s: %s", method, why)
        return None
    return {
        "measured": {str(s.decade): s.log10_rmse for s in own},
        "completed": {str(s.decade): s.log10_rmse for s in full},
        "coverage": {str(s.decade): s.coverage for s in own},
    }


def _z(mean: Array, variance: Array, truth: Truth, lit: Bool) -> dict[str, Any]:
    totals = {name: z_of_totals(mean, variance, truth, chosen) for name, chosen in (("lit", lit), ("unlit", ~lit))}
    return {
        "entries": {decade: asdict(own) for decade, own in z_of_entries(mean, variance, truth).items()},
        "totals": {name: {errors: asdict(own) for errors, own in parts.items()} for name, parts in totals.items()},
    }
