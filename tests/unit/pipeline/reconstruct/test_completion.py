"""The completion on objects whose R_d is known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from reconstruct_synthetic import Synthetic, make, rmse_log10

from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.mesh import RayMesh
from pipeline.model.reflectance import GlobalTerm
from pipeline.reconstruct.global_term import completion
from pipeline.reconstruct.global_term.completion import (
    RANGE_EDGES,
    SymmetricField,
    complete,
    fit_laser,
    hold_measured,
    measured_entries,
)
from pipeline.reconstruct.global_term.harmonics import harmonics
from pipeline.reconstruct.global_term.prior import FAR, medium_priors
from pipeline.reconstruct.methods import reconstruct
from pipeline.reconstruct.omissions import colour_groups, is_opaque
from pipeline.reconstruct.samples.samples import Samples
from pipeline.reconstruct.samples.spots import tilts


@pytest.fixture(scope="module")
def field(small: Synthetic) -> SymmetricField:
    s = small.samples
    return SymmetricField.of(harmonics(s.mesh, 500), s.lit, 3.0)


@pytest.fixture(scope="module")
def completed(small: Synthetic) -> GlobalTerm:
    """The small object's R_d."""
    return complete(small.samples).terms[0]


def test_solve_agrees_with_the_dense_normal_equations(small: Synthetic, field: SymmetricField) -> None:
    """Rationale: the plain float64 solution of the same least squares, unknown by unknown."""
    rng = np.random.default_rng(1)
    n = 12
    cut = SymmetricField(field.vertices[:, :n], field.spots[:, :n], field.penalty[:n, :n])
    shape = (len(cut.spots), len(cut.vertices))
    target, weight, scale = rng.standard_normal(shape), rng.uniform(0, 2, shape), rng.uniform(0.1, 1, shape)
    weight[rng.random(shape) < 0.3] = 0.0
    u, b = cut.vertices.astype(float), cut.spots.astype(float)
    design = np.einsum("si,vj->svij", b, u).reshape(-1, n * n)
    pairs = [(i, j) for i in range(n) for j in range(i + 1)]
    to_full = np.zeros((n * n, len(pairs)))
    for k, (i, j) in enumerate(pairs):
        to_full[i * n + j, k] = to_full[j * n + i, k] = 1.0
    x = (design * scale.reshape(-1, 1)) @ to_full
    penalty = to_full.T @ (cut.penalty.astype(float).ravel()[:, None] * to_full)
    normal = x.T @ (weight.reshape(-1, 1) * x) + penalty
    dense = to_full @ np.linalg.solve(normal, x.T @ (weight * target).ravel())
    y = cut.solve(target, weight, scale, np.zeros((n, n), np.float32))
    assert np.abs(y.ravel() - dense).max() < 0.03 * np.abs(dense).max()
    np.testing.assert_allclose(y, y.T)


def test_completes_what_was_not_measured(small: Synthetic, completed: GlobalTerm) -> None:
    """Expected behaviour: entries without any sample near them come out nearly as well as measured ones."""
    model = completed
    r = model.reflectance[0]
    np.testing.assert_array_equal(r, r.T)
    assert (r > 0).all()
    assert 0.3 < model.measured.mean() < 0.95
    for part in (model.measured, ~model.measured):
        assert rmse_log10(r[part], small.truth[0][part]) < 0.06
    area = RayMesh.of(small.samples.mesh).vertex_areas
    ratio = (r @ area) / (small.truth[0] @ area)
    assert abs(ratio.mean() - 1) < 0.02
    assert ratio.std() < 0.06


def test_variance_covers_the_error(small: Synthetic, completed: GlobalTerm) -> None:
    """Expected behaviour: errors are within a few of the stated deviations, and rarely beyond."""
    z = (completed.reflectance[0] - small.truth[0]) / np.sqrt(completed.variance[0])
    assert np.sqrt((z**2).mean()) < 1.5
    assert (np.abs(z) > 4).mean() < 0.01


def spots_on_vertices(made: Synthetic, rng: np.random.Generator) -> tuple[Samples, np.ndarray, np.ndarray]:
    """Samples without noise whose spots lie on vertices and are off by 40 % from entry to entry; spots; vertices."""
    s = made.samples
    lit = s.mesh.faces[s.spots.triangle, 0]
    first = np.unique(lit, return_index=True)[1]
    transmitted = np.where(np.isin(np.arange(len(lit)), first), s.spots.transmitted, 0.0)
    corner = np.tile([1.0, 0.0, 0.0], (len(lit), 1))
    spots = replace(s.spots, barycentric=corner, position=np.asarray(s.mesh.vertices)[lit], transmitted=transmitted)
    values = (s.values * np.exp(0.4 * rng.choice([-1, 0, 1], s.values.shape))).astype(np.float32)
    values[:, transmitted == 0] = np.nan
    none = np.zeros_like(values)
    tilt = rng.uniform(-0.8, 0.2, s.values[0].shape)
    values = values * (1 + 0.3 * tilt).astype(np.float32)
    seen = replace(s, spots=spots, values=values, dark_variance=none, noise_per_signal=none, tilt=tilt)
    return seen, first, lit[first]


def test_measured_entries_hold_the_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rationale: spots that lie on vertices. An entry (u, v) is held by the sample of the spot at u read at v, carried
    from beam to hat function and from one direction to all by the ratio of the fit's expectations.
    Expected behaviour: without noise exactly that, whatever the samples say - most of them are off by 40 % from entry
    to entry, which no smooth fill would follow; every entry that one spot observed, and no other, is called measured.
    """
    s, spots, vertices = spots_on_vertices(make(spots=80, noise=0.0, contrast=0.0), np.random.default_rng(7))
    monkeypatch.setattr(completion, "steady_totals", lambda reflectance, *_: reflectance)  # a factor a vertex
    model = complete(s).terms[0]
    smooth = SymmetricField.of(harmonics(s.mesh, 500), s.lit, RANGE_EDGES * float(s.mesh.edges_unique_length.mean()))
    fit = fit_laser(s, 0, smooth, np.zeros_like(smooth.penalty), medium_priors(s)[1])
    expected = fit.at_spots * fit.tilt.factor(s.spot_pairs.distance, s.tilt)
    assert np.abs(fit.tilt(np.array([1.0, 3.0])) * 0.5).max() > 0.05  # the samples' tilt was seen
    observed = np.isfinite(s.values[0])
    by_one_spot = np.zeros_like(model.measured)
    checked = 0
    for spot, u in zip(spots, vertices, strict=True):
        by_one_spot[u, observed[spot]] = True
        for v in np.flatnonzero(observed[spot]):
            other = [q for q, w in zip(spots, vertices, strict=True) if w == v and q != spot and observed[q, u]]
            if not other:
                held = s.values[0, spot, v] * fit.entries[u, v] / expected[spot, v]
                assert model.reflectance[0, u, v] == pytest.approx(held, rel=1e-5)
                assert model.reflectance[0, v, u] == model.reflectance[0, u, v]
                checked += 1
    assert checked > 1000
    assert (by_one_spot | by_one_spot.T)[model.measured].mean() > 0.3
    assert model.measured[by_one_spot | by_one_spot.T].all()


def test_noise_decides_between_sample_and_fill() -> None:
    """Rationale: one spot per vertex; noise as large as the fill's own deviation moves the entry half-way to the fill.
    Expected behaviour: the mean by precisions, and the variance that goes with it; the entry stays measured.
    """
    s, _, _ = spots_on_vertices(make(spots=80, noise=0.0, contrast=0.0), np.random.default_rng(8))
    smooth = SymmetricField.of(harmonics(s.mesh, 500), s.lit, 6.0)
    fit = fit_laser(s, 0, smooth, np.zeros_like(smooth.penalty), FAR)
    one, left = np.ones_like(fit.entries), np.full_like(fit.entries, 0.09)
    sure, nothing, measured = hold_measured(s, [fit], one, left)
    expected = fit.at_spots * fit.tilt.factor(s.spot_pairs.distance, s.tilt)
    noisy = replace(s, dark_variance=(0.09 * expected**2)[None].astype(np.float32))
    between, half, again = hold_measured(noisy, [fit], one, left)
    np.testing.assert_array_equal(measured, again)
    single = measured & (half[0] > 0.044)  # entries with one spot; those with two or three trust them more
    assert single.sum() > 1000
    np.testing.assert_allclose(between[0][single], 0.5 * (sure[0] + fit.entries)[single], rtol=1e-3)
    np.testing.assert_allclose(half[0][single], 0.045, rtol=1e-3)
    assert nothing[0][measured].max() < 1e-6
    np.testing.assert_array_equal(nothing[0][~measured], 0.09)


def test_prior_of_the_field_has_unit_variance(small: Synthetic) -> None:
    """Rationale: draw Y from exp(-Y penalty Y / 2) over symmetric Y; G = U Y U^T is to have mean variance 1."""
    field = SymmetricField.of(harmonics(small.samples.mesh, 500), small.samples.lit, 3.0)
    rng, n = np.random.default_rng(9), len(field.penalty)
    drawn = []
    for _ in range(40):
        y = rng.standard_normal((n, n)) / np.sqrt(2 * field.penalty)  # a pair (i, j), (j, i) costs 2 penalty y^2 / 2
        y = np.tril(y, -1)
        y = y + y.T + np.diag(rng.standard_normal(n) / np.sqrt(np.diag(field.penalty)))
        drawn.append(((field.vertices @ y @ field.vertices.T) ** 2).mean())
    z = (np.mean(drawn) - 1) / (np.std(drawn) / np.sqrt(len(drawn)))
    assert abs(z) < 4


def test_the_boundary_is_compared_with_what_each_view_expects(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rationale: what directions do to R_d is in the expectation, or the boundary's ratio would take it for its own."""
    s, _, _ = spots_on_vertices(make(spots=80, noise=0.0, contrast=0.0), np.random.default_rng(7))
    asked = []
    monkeypatch.setattr(completion, "measure_boundary", lambda *a: asked.append(a) or Boundary(1.3))
    complete(s)
    ((_, _, _, expected),) = asked
    eyes = [np.array([300.0, 0, 0]), np.array([0, 0, -300.0])]
    views = [expected(SimpleNamespace(camera=SimpleNamespace(position=eye)))[0] for eye in eyes]
    lean = [sum(tilts(s.mesh, s.spots, eye, s.eta)) for eye in eyes]
    smooth = SymmetricField.of(harmonics(s.mesh, 500), s.lit, RANGE_EDGES * float(s.mesh.edges_unique_length.mean()))
    tilt = fit_laser(s, 0, smooth, np.zeros_like(smooth.penalty), medium_priors(s)[1]).tilt
    factors = [tilt.factor(s.spot_pairs.distance, one) for one in lean]
    assert np.abs(factors[0] - factors[1]).max() > 0.1
    np.testing.assert_allclose(views[0] / views[1], factors[0] / factors[1], rtol=1e-5)


def test_size_does_not_matter(small: Synthetic, completed: GlobalTerm) -> None:
    """Rationale: the same object ten times as large: R_d is a hundredth. Nothing in the method is a length in mm."""
    s = small.samples
    mesh = s.mesh.copy()
    mesh.apply_scale(10.0)
    spots = replace(s.spots, position=10 * s.spots.position, beam_radius=10 * s.spots.beam_radius)
    grown = replace(
        s, mesh=mesh, spots=spots, values=s.values / 100, dark_variance=s.dark_variance / 1e4,
        noise_per_signal=s.noise_per_signal / 100,
    )  # fmt: skip
    np.testing.assert_allclose(100 * complete(grown).terms[0].reflectance, completed.reflectance, rtol=0.02)


def test_a_spot_pulls_the_model_as_far_as_its_precision_says(small: Synthetic, field: SymmetricField) -> None:
    """Rationale: one spot's samples raised by half: precise, the model follows; said to be noisy, it does not."""
    s = small.samples
    spot = 11
    raised = s.values.copy()
    raised[:, spot] *= 1.5
    noisy = s.noise_per_signal.copy()
    noisy[:, spot] *= 1e5
    zero = np.zeros_like(field.penalty)
    base = fit_laser(s, 0, field, zero, FAR).at_spots[spot]
    far = (s.spot_pairs.distance[spot] > 5) & np.isfinite(s.values[0, spot])
    sure = fit_laser(replace(s, values=raised), 0, field, zero, FAR).at_spots[spot]
    unsure = fit_laser(replace(s, values=raised, noise_per_signal=noisy), 0, field, zero, FAR).at_spots[spot]
    assert np.log(sure / base)[far].mean() > 0.15
    assert abs(np.log(unsure / base)[far].mean()) < 0.03


def test_noisy_tails_do_not_bias() -> None:
    """Rationale: tails drowned in noise, half of them negative; the old remedy (logarithms) fails here."""
    made = make(noise=0.02, hidden=0.0)
    rng = np.random.default_rng(3)
    level = 3e-4  # of the order of the values at half a turn
    values = made.samples.values + level * rng.standard_normal(made.samples.values.shape).astype(np.float32)
    dark = np.full_like(values, level**2)
    model = complete(replace(made.samples, values=values, dark_variance=dark)).terms[0]
    clean = complete(made.samples).terms[0]
    tail = made.samples.vertex_pairs.distance > 10
    assert (values[0][made.samples.spot_pairs.distance > 14] < 0).mean() > 0.2
    noise, fit = (np.log(model.reflectance[0][tail].sum() / m[0][tail].sum()) for m in (clean.reflectance, made.truth))
    far = (made.samples.spot_pairs.distance > 10) & np.isfinite(values[0])
    error = level * np.sqrt(far.sum()) / made.samples.values[0][far].sum()  # of the light that was seen there
    assert error < 0.05
    assert abs(noise) < 4 * error
    # The prior leaves more open than this object varies; the expectation over a log-normal is half the variance higher.
    assert abs(fit) < 4 * error + 0.5 * (model.variance[0] / model.reflectance[0] ** 2)[tail].mean()


def test_equal_wavelengths_are_solved_once_and_nothing_changes() -> None:
    """Rationale: leaving a wavelength out that equals another is forced on; the model is the same bits."""
    made = make(spots=40)
    double = replace(
        made.samples,
        values=np.repeat(made.samples.values, 2, axis=0),
        dark_variance=np.repeat(made.samples.dark_variance, 2, axis=0),
        noise_per_signal=np.repeat(made.samples.noise_per_signal, 2, axis=0),
    )
    assert colour_groups(double) == [0, 0]
    assert colour_groups(make(spots=40, lasers=2).samples) == [0, 1]
    model = reconstruct(double, "default").terms[0]
    np.testing.assert_array_equal(model.reflectance[0], model.reflectance[1])
    forced = complete(double).terms[0]  # both solved; the second starts from the first and stops a little further on
    np.testing.assert_allclose(model.reflectance[1], forced.reflectance[1], rtol=0.05)


def test_opaque_objects_have_no_global_term() -> None:
    made = make(spots=60, noise=0.0)
    local = made.samples.spot_pairs.mean(lambda d: np.exp(-d / 0.1) + 1e-12)
    values = np.where(np.isfinite(made.samples.values), local, np.nan).astype(np.float32)
    opaque = replace(made.samples, values=values)
    assert is_opaque(opaque)
    assert not is_opaque(made.samples)
    model = reconstruct(opaque, "default")
    assert [term.kind for term in model.terms] == ["lambertian"]
    assert model.provenance == {"method": "default"}
    assert model.reflectance_columns([0]) is None


def test_measured_entries_come_in_pairs(small: Synthetic) -> None:
    entries = measured_entries(small.samples)
    np.testing.assert_array_equal(entries, entries.T)
