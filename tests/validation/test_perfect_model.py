"""The score of a perfect model is 0 within its error, made from the truth itself, on objects of every kind.

Rationale: two truths of one object from different photons. One, divided by the square of a boundary's mean
transmittance, is R_d of a model; the other is what it is scored by. Which index the object has, and which one the model
assumes, must not matter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy import stats
from significance import assert_z
from twins import twin

from disco_twin.evaluate.entries import score_entries
from disco_twin.evaluate.neck import score_neck
from disco_twin.evaluate.totals import score_totals, true_totals
from disco_twin.evaluate.z_scores import ZScores, z_of_entries, z_of_totals
from disco_twin.experiment.experiment import Experiment
from disco_twin.light.transport import Transport
from disco_twin.light.truth import REPLICATES, Truth, standard_error, truth_columns
from disco_twin.object.build import hat_basis
from disco_twin.scene.scene import load_scene
from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.remesh import remesh
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel

F64, I64 = NDArray[np.floating], NDArray[np.int64]
BOUNDARIES = (Boundary(1.3), Boundary(1.8), Boundary(1.3, (0.1, 0.3, 0.9), (1.9, 1.1, 0.97)))


def symmetric(replicates: F64) -> F64:
    """(R, L, V, V) with the mean of each entry and its reciprocal one."""
    return np.asarray(0.5 * (replicates + replicates.transpose(0, 1, 3, 2)))


def signed_square(root: float) -> float:
    """x |x|."""
    return root * abs(root)


def expected_z2(ratio: float) -> tuple[float, float]:
    """Mean square, and share beyond 3, of z-scores of Gaussian errors whose variances come from eight replicates each.

    ratio: the model's variance over the truth's. The truth's is raised by 7 / 5, so that alone it had the mean square 1
    (docs/z-scores.md); the model's is as it states it.
    """
    random, freedom = np.random.default_rng(0), REPLICATES - 1
    truth, own = random.chisquare(freedom, (2, 400_000)) / freedom
    over = (freedom / (freedom - 2) * truth + ratio * own) / (1 + ratio)
    return float((1 / over).mean()), float(2 * stats.norm.sf(3 * np.sqrt(over)).mean())


def z_of_columns(sums: F64, counts: F64, expected: float) -> float:
    """(n,) sums and counts by column -> z-score of sums / counts over all columns, by the scatter of columns."""
    off = sums - expected * counts
    t = off.mean() / (off.std(ddof=1) / np.sqrt(len(off)))
    return float(np.sign(t) * stats.norm.isf(stats.t.sf(abs(t), len(off) - 1)))


def by_column(truth: Truth, mean: F64, variance: F64) -> list[ZScores]:
    """z-scores of each column's entries of all decades together."""
    out = []
    for k in range(len(truth.columns)):
        own = replace(truth, columns=truth.columns[k : k + 1], replicates=truth.replicates[:, :, k : k + 1])
        parts = [z for z in z_of_entries(mean[:, k : k + 1], variance[:, k : k + 1], own).values() if z.count]
        count = sum(z.count for z in parts)
        square = sum(z.count * z.rms**2 for z in parts) / count
        out.append(ZScores(count, square**0.5, sum(z.count * z.beyond_3 for z in parts) / count))
    return out


def assert_entries_are_noise(estimate: Truth, truth: Truth, model: Callable[[F64], F64]) -> None:
    """log10_rmse by decade is what noise makes of a perfect model: that of any other two halves of all replicates."""
    random, every = np.random.default_rng(0), np.concatenate([estimate.replicates, truth.replicates])

    def squares(order: I64) -> F64:
        own, other = model(every[order[:REPLICATES]]), every[order[REPLICATES:]]
        error = np.hypot(standard_error(own), standard_error(other))
        scores = score_entries(own.mean(axis=0), other.mean(axis=0), error, True)
        return np.array([signed_square(s.log10_rmse) if s.entries > 100 else np.nan for s in scores])

    others = np.stack([squares(random.permutation(2 * REPLICATES)) for _ in range(40)])
    many = np.isfinite(others).all(axis=0)
    t = (squares(np.arange(2 * REPLICATES)) - others.mean(axis=0))[many] / others.std(axis=0, ddof=1)[many]
    assert many.any()
    assert_z(np.sign(t) * stats.norm.isf(stats.t.sf(np.abs(t), len(others) - 1)), "log10_rmse by decade")


def scored_as_perfect(estimate: Truth, truth: Truth, model: Callable[[F64], F64], mean: F64, variance: F64) -> None:
    """Entries, totals and z-scores of a model show its noise and the truth's, and nothing else.

    model: (8, L, n, V) replicates of the estimate -> the model's; mean, variance: (L, n, V) what it states
    """
    assert_entries_are_noise(estimate, truth, model)
    replicates = model(estimate.replicates)
    usable = (truth.mean > 0) & (truth.standard_error < 0.5 * truth.mean)
    square, beyond = expected_z2(float(np.median(variance[usable] / truth.standard_error[usable] ** 2)))
    columns = by_column(truth, mean, variance)
    counts = np.array([z.count for z in columns], float)
    for label, each, expected in (
        ("mean square", np.array([z.rms**2 for z in columns]), square),
        ("beyond 3", np.array([z.beyond_3 for z in columns]), beyond),
    ):
        assert_z(z_of_columns(counts * each, counts, expected), f"z-scores of entries, {label} {expected:.4f}")

    n, everywhere = len(truth.columns), np.ones(len(truth.columns), bool)
    totals, (exact, error) = score_totals(mean @ truth.area, truth, everywhere), true_totals(truth)
    own = standard_error(replicates @ truth.area)
    noise, others = ((x / exact) ** 2 for x in (own, error))
    # A symmetric matrix counts each entry in two columns: their mean scatters by up to twice a column's variance.
    z = (np.array(totals.mean) - 1) / np.sqrt((2 * noise + others).mean(axis=1) / n)
    assert_z(z, "totals")
    spread = np.array([s * abs(s) for s in totals.spread])
    scatter = (noise + others).mean(axis=1) * np.sqrt(2 / (n - 1) + 2 / (n * (REPLICATES - 1)))
    assert_z((spread - noise.mean(axis=1)) / scatter, "scatter of totals")
    assert z_of_totals(mean, variance, truth, everywhere)["alike"].rms < 1


@pytest.mark.parametrize(
    ("shape", "kind", "eta", "g"),
    [
        pytest.param("sphere", "rough", 1.5, 0.0, marks=pytest.mark.slow),
        ("torus", "rough", 1.4, 0.6),
        ("box", "matched", 1.0, 0.0),
    ],
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
    matrix = symmetric(estimate.replicates)
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
    np.testing.assert_allclose(own.mean, matrix.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(own.variance, standard_error(matrix) ** 2, rtol=1e-4)
    scored_as_perfect(estimate, truth, symmetric, own.mean, own.variance)

    beyond = np.asarray(scan.vertices)[:, 0] > 0.7
    neck = score_neck({"own": leaving, "bright": 1.1 * leaving}, truth, beyond)
    noise = score_neck({}, replace(truth, replicates=matrix), beyond)
    for direction, share in neck.items():
        np.testing.assert_allclose(share["methods"]["own"], noise[direction]["truth"], rtol=1e-5)
        off = np.subtract(share["methods"]["own"], share["truth"])
        t = off / np.hypot(share["truth_se"], noise[direction]["truth_se"])
        assert_z(np.sign(t) * stats.norm.isf(stats.t.sf(np.abs(t), REPLICATES - 1)), f"neck, {direction}")
        np.testing.assert_allclose(share["methods"]["bright"], 1.1 * np.array(share["methods"]["own"]))

    everywhere, error = np.ones(len(columns), bool), np.hypot(truth.standard_error, np.sqrt(own.variance))
    plain, bright = (score_totals(scale * leaving.sum(axis=2), truth, everywhere) for scale in (1.0, 1.1))
    np.testing.assert_allclose(bright.mean, 1.1 * np.array(plain.mean))
    shift = np.log10(1.1)
    perfect, tenth = (score_entries(scale * own.mean, truth.mean, error, True)[0] for scale in (1.0, 1.1))
    square = signed_square(perfect.log10_rmse) + 2 * shift * perfect.log10_bias + shift**2
    assert signed_square(tenth.log10_rmse) == pytest.approx(square, rel=1e-6)


SCENES = sorted(p for p in (Path(__file__).resolve().parents[2] / "scenes").rglob("*.toml"))


@pytest.mark.slow
@pytest.mark.parametrize("path", SCENES, ids=lambda p: p.stem)
def test_two_truths_of_every_shipped_scene_agree(path: Path) -> None:
    """Expected behaviour: as above, on the objects that scenes ship, from photons of two seeds."""
    experiment = Experiment(load_scene(path))
    columns = np.linspace(0, len(experiment.scan.vertices) - 1, 6).astype(int)
    basis = hat_basis(experiment.object.mesh, experiment.scan)
    estimate, truth = (truth_columns(experiment.transport, basis, columns, 40_000, seed) for seed in (11, 12))
    scored_as_perfect(estimate, truth, lambda own: own, estimate.mean, estimate.standard_error**2)
