"""The score of a perfect model is 0 within its error, made from the truth itself, on objects of every kind.

Rationale: two truths of one object from different photons. One, divided by the square of a boundary's mean
transmittance, is R_d of a model; the other is what it is scored by. Which index the object has, and which one the model
assumes, must not matter.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from significance import assert_z, threshold
from twins import twin

from disco_twin.evaluate.entries import score_entries
from disco_twin.evaluate.neck import score_neck
from disco_twin.evaluate.totals import score_totals, true_totals
from disco_twin.evaluate.z_scores import z_of_entries, z_of_totals
from disco_twin.experiment.experiment import Experiment
from disco_twin.light.transport import Transport
from disco_twin.light.truth import Truth, standard_error, truth_columns
from disco_twin.object.build import hat_basis
from disco_twin.object.remesh import remesh
from disco_twin.scene.scene import load_scene
from pipeline.geometry.fresnel import Boundary
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel

BOUNDARIES = (Boundary(1.3), Boundary(1.8), Boundary(1.3, (0.1, 0.3, 0.9), (1.9, 1.1, 0.97)))


def scored_as_perfect(estimate: Truth, truth: Truth, mean: np.ndarray, variance: np.ndarray) -> None:
    """Entries, totals and z-scores of (L, n, V) exitance that comes from `estimate` show its noise and the truth's."""
    both = np.sqrt(truth.standard_error**2 + variance)
    seen = truth.mean > 0
    noise = np.log10(np.e) * np.median(both[seen] / truth.mean[seen])
    z = z_of_entries(mean, variance, truth)
    for score in score_entries(mean, truth.mean, both, True):
        if score.entries > 100 and score.log10_rmse is not None:
            own = z[str(score.decade)]
            # Weights of few photons are not Gaussian where little light comes, and both variances are estimates.
            assert own.rms == pytest.approx(1, abs=0.3), score
            assert own.beyond_3 is not None
            assert own.beyond_3 < 0.03
            assert abs(score.log10_rmse) < max(0.5 * noise, 0.03), score
    n = len(truth.columns)
    chosen = np.ones(n, bool)
    totals = score_totals(mean @ truth.area, truth, chosen)
    own, error = true_totals(truth)
    _, other = true_totals(estimate)
    relative = np.sqrt((error**2 + other**2).mean(axis=1)) / own.mean(axis=1)
    assert_z((np.array(totals.mean) - 1) / (relative / np.sqrt(n)), "totals")
    assert (np.abs(totals.spread) < 3 * relative).all()
    assert z_of_totals(mean, variance, truth, chosen)["alike"].rms < 1


@pytest.mark.parametrize(
    ("shape", "kind", "eta", "g"),
    [("sphere", "rough", 1.5, 0.0), ("torus", "rough", 1.4, 0.6), ("box", "matched", 1.0, 0.0)],
)
def test_a_model_made_of_one_truth_is_perfect_by_another(shape: str, kind: str, eta: float, g: float) -> None:
    """Expected behaviour: log10 rmse 0, totals 1 and z-scores 1 within their errors, the same for every boundary that
    the model states; a model that is a tenth too bright scores a tenth.
    """
    fine = {
        "sphere": trimesh.creation.icosphere(subdivisions=3, radius=3.0),
        "torus": trimesh.creation.torus(4.0, 1.5, major_sections=60, minor_sections=24),
        "box": trimesh.creation.box(extents=(6.0, 4.0, 3.0)).subdivide_to_size(0.4),
    }[shape]
    scan = remesh(fine, 100)
    transport = Transport(twin(fine, kind, eta, 1.5, [0.98], g), cells=64)  # type: ignore[arg-type]
    basis, columns = hat_basis(fine, scan), np.arange(len(scan.vertices))
    estimate, truth = (truth_columns(transport, basis, columns, 3200, seed) for seed in (1, 2))
    matrix = 0.5 * (estimate.replicates + estimate.replicates.transpose(0, 1, 3, 2))
    seen = []
    for boundary in BOUNDARIES:
        level = boundary.mean_transmittance**2
        variance = (standard_error(matrix) / level) ** 2
        entries, everywhere = (matrix.mean(axis=0) / level).astype(np.float32), np.ones(matrix.shape[2:], bool)
        term = GlobalTerm(entries, everywhere, variance.astype(np.float32))
        model = RelightableModel(scan, boundary, (term,))
        own, leaving = model.exitance_columns(columns), model.leaving(columns, truth.area)
        assert own is not None
        assert own.variance is not None
        assert leaving is not None
        seen.append(own.mean)
        np.testing.assert_allclose(own.mean, seen[0], rtol=1e-5)
    scored_as_perfect(estimate, truth, own.mean, own.variance)
    beyond = np.asarray(scan.vertices)[:, 0] > 0.7
    neck = score_neck({"own": leaving, "bright": 1.1 * leaving}, truth, beyond)
    for direction, share in neck.items():
        off = (np.array(share["methods"]["own"]) - share["truth"]) / (np.sqrt(2) * np.array(share["truth_se"]))
        assert np.abs(off).max() < threshold(2, 1e-3) + 2, direction  # Student's t: two deviations from 8 replicates
        np.testing.assert_allclose(share["methods"]["bright"], 1.1 * np.array(share["methods"]["own"]))
    bright = score_totals(1.1 * leaving.sum(axis=2), truth, np.ones(len(columns), bool))
    assert bright.mean == pytest.approx((1.1,), rel=0.01)
    tenth = score_entries(1.1 * own.mean, truth.mean, np.hypot(truth.standard_error, np.sqrt(own.variance)), True)
    assert tenth[0].log10_rmse == pytest.approx(np.log10(1.1), rel=0.15)


SCENES = sorted(p for p in (Path(__file__).resolve().parents[2] / "scenes").rglob("*.toml"))


@pytest.mark.slow
@pytest.mark.parametrize("path", SCENES, ids=lambda p: p.stem)
def test_two_truths_of_every_shipped_scene_agree(path: Path) -> None:
    """Expected behaviour: as above, on the objects that scenes ship, from photons of two seeds."""
    experiment = Experiment(load_scene(path))
    columns = np.linspace(0, len(experiment.scan.vertices) - 1, 6).astype(int)
    basis = hat_basis(experiment.object.mesh, experiment.scan)
    estimate, truth = (truth_columns(experiment.transport, basis, columns, 40_000, seed) for seed in (11, 12))
    scored_as_perfect(estimate, truth, estimate.mean, estimate.standard_error**2)
