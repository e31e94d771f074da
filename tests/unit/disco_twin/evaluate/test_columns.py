"""Scores of columns whose error is known: totals, the light across a neck, z-scores."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from known_truth import F64, exitance, made_truth
from significance import assert_z

from disco_twin.evaluate.neck import score_neck
from disco_twin.evaluate.totals import score_totals, true_totals
from disco_twin.evaluate.z_scores import ZScores, reference_variance, z_of_entries, z_of_pixels, z_of_totals
from disco_twin.light.truth import Truth
from pipeline.geometry.mesh import RayMesh

MESH = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
AREA = RayMesh.of(MESH).vertex_areas
EXACT = exitance(np.asarray(MESH.vertices))
COLUMNS = np.arange(0, len(AREA), 9)
ALL = np.ones(len(COLUMNS), bool)
ONE = np.ones((8, 3, len(COLUMNS), len(AREA)))


def truth(noise: float = 0.02, seed: int = 0, exact: F64 = EXACT, columns: F64 = COLUMNS, area: F64 = AREA) -> Truth:
    return made_truth(exact, columns, area, noise, seed)


def totals(factor: F64 | float = 1.0) -> F64:
    return np.asarray((EXACT[:, COLUMNS] @ AREA) * factor)


# ---- totals


def test_a_perfect_model_s_totals_are_the_truth_s_within_their_noise() -> None:
    """Rationale: many truths of one object. Expected: the mean ratio is 1 and the spread 0 within their errors."""
    scores = [score_totals(totals(), truth(0.05, seed), ALL) for seed in range(40)]
    z = np.array([(np.array(s.mean) - 1) / np.array(s.mean_se) for s in scores])
    assert_z(z.mean(axis=0) * np.sqrt(len(z)), "mean")
    assert z.std() == pytest.approx(1, abs=0.3)
    spread2 = np.array([[x * abs(x) for x in s.spread] for s in scores])
    assert_z(spread2.mean() / (spread2.std() / np.sqrt(spread2.size)), "spread")
    assert spread2.min() < 0  # nothing is clipped


@pytest.mark.parametrize("spread", [0.02, 0.1])
def test_a_known_error_is_found_beside_the_truth_s_noise(spread: float) -> None:
    """Totals 7 % too high that scatter by a known share; the truth's own scatter by as much is removed."""
    rng = np.random.default_rng(1)
    noise = spread / np.sqrt((EXACT[:, COLUMNS] ** 2 @ AREA**2) / totals() ** 2).mean()
    found = []
    for seed in range(30):
        draw = rng.standard_normal(len(COLUMNS))
        model = totals(1.07 * (1 + spread * (draw - draw.mean()) / draw.std()))
        s = score_totals(model, truth(noise, seed), ALL)
        assert s.columns == len(COLUMNS)
        found.append((s.mean, s.spread, s.spread_se))
    mean, own, error = np.mean(found, axis=0)
    assert mean == pytest.approx(1.07 * (1 + spread**2), rel=0.005)  # the mean of one over a noisy total is larger
    assert own == pytest.approx(spread, rel=0.1)
    assert error == pytest.approx(np.std([f[1] for f in found]), rel=0.4)


def test_lit_and_unlit_columns_are_apart_and_too_few_have_no_spread() -> None:
    lit = np.arange(len(COLUMNS)) % 2 == 0
    model = totals(np.where(lit, 1.0, 0.9))
    exact = truth(0.0)
    assert score_totals(model, exact, lit).mean == pytest.approx([1.0] * 3)
    assert score_totals(model, exact, ~lit).mean == pytest.approx([0.9] * 3)
    one = score_totals(model, exact, np.arange(len(COLUMNS)) == 1)
    assert (one.columns, one.mean, one.spread) == (1, pytest.approx((0.9,) * 3), (None,) * 3)
    none = score_totals(model, exact, ~ALL)
    assert (none.columns, none.mean, none.mean_se) == (0, (None,) * 3, (None,) * 3)
    dark = score_totals(0 * model, exact, ALL)
    assert (dark.mean, dark.spread) == ((0.0,) * 3, (None,) * 3)
    json.dumps(dark.spread, allow_nan=False)


def test_a_wavelength_that_is_absorbed_wholly_has_no_totals() -> None:
    exact = truth(0.05)
    replicates = exact.replicates.copy()
    replicates[:, 1] = 0.0
    s = score_totals(totals(), replace(exact, replicates=replicates), ALL)
    assert s.mean[1] is None and s.spread[1] is None
    assert s.mean[0] == pytest.approx(1.0, abs=0.05)


def test_totals_are_sums_over_area() -> None:
    """Rationale: a mesh with larger hats on one side; the same light leaves however finely it is counted."""
    area = AREA * np.where(MESH.vertices[:, 0] > 0, 2.0, 0.5)
    s = score_totals(EXACT[:, COLUMNS] @ area, truth(0.0, area=area), ALL)
    assert s.mean == pytest.approx([1.0] * 3)
    assert not np.allclose(totals(), EXACT[:, COLUMNS] @ area, rtol=0.05)


# ---- head and body


def test_the_light_across_a_plane_is_what_was_put_there() -> None:
    """Rationale: a sphere cut off its middle; a model that lets half as much across, one that lets nothing across."""
    beyond = np.asarray(MESH.vertices)[:, 2] > 3.0
    other = beyond[COLUMNS][:, None] != beyond
    leaving = EXACT[:, COLUMNS] * AREA
    models = {"exact": leaving, "half": leaving * np.where(other, 0.5, 1.0), "opaque": leaving * ~other}
    found = score_neck(models, truth(0.02), beyond)
    for direction, side in (("along_normal", ~beyond[COLUMNS]), ("against_normal", beyond[COLUMNS])):
        own = found[direction]
        plain = [
            sum(AREA[COLUMNS[u]] * EXACT[laser, COLUMNS[u], v] * AREA[v]
                for u in np.flatnonzero(side) for v in np.flatnonzero(other[u]))
            / sum(AREA[COLUMNS[u]] for u in np.flatnonzero(side))
            for laser in range(3)
        ]  # fmt: skip
        assert own["columns"] == side.sum()
        assert own["methods"]["exact"] == pytest.approx(plain)
        assert own["methods"]["half"] == pytest.approx(0.5 * np.array(plain))
        assert own["methods"]["opaque"] == [0, 0, 0]
        assert_z((np.array(own["truth"]) - plain) / own["truth_se"], direction)
    nowhere = score_neck(models, replace(truth(), columns=np.zeros_like(COLUMNS)), np.arange(len(AREA)) > 0)
    assert nowhere["against_normal"] == {"columns": 0, "truth": None, "truth_se": None, "methods": {}}


# ---- z-scores


@pytest.mark.parametrize("wrong", [1.0, 3.0])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_z_scores_are_one_where_the_variances_are_right(wrong: float, share: float) -> None:
    """Rationale: errors of 10 % in all, a share of their variance the model's and the rest the truth's.
    Expected: rms 1 in every decade, independent errors of entries alike in the totals; where errors are three times as
    large as stated the rms is three.
    """
    rng = np.random.default_rng(2)
    own = 0.1 * np.sqrt(share)
    model = EXACT[:, COLUMNS] * (1 + wrong * own * rng.standard_normal(EXACT[:, COLUMNS].shape))
    variance = (own * EXACT[:, COLUMNS]) ** 2
    exact = truth(wrong * 0.1 * np.sqrt(1 - share), seed=3)
    expected = wrong / np.sqrt(share + (1 - share) * wrong**2)  # the truth's own noise is measured, not stated
    entries = z_of_entries(model, variance, exact)
    assert set(entries) == {"0", "-1", "-2", "-3"}
    for decade, z in entries.items():
        assert z.count > 300, decade
        assert z.rms == pytest.approx(expected, rel=0.08), decade
    if wrong == 1:
        assert max(z.beyond_3 for z in entries.values() if z.beyond_3 is not None) < 0.02
    both = z_of_totals(model, variance, exact, ALL)
    assert both["independent"].count == 3 * len(COLUMNS)
    assert both["independent"].rms == pytest.approx(expected, rel=0.25)
    assert share == 0 or both["alike"].rms < both["independent"].rms


def test_errors_that_are_alike_are_understated_as_independent_ones() -> None:
    """Rationale: every entry 5 % too high where 5 % are stated: a common factor. Expected: z of totals is 1 with errors
    that are alike, and many times that with independent ones.
    """
    model = EXACT[:, COLUMNS] * 1.05
    both = z_of_totals(model, (0.05 * EXACT[:, COLUMNS]) ** 2, truth(1e-5), ALL)
    assert both["alike"].rms == pytest.approx(1.0, rel=1e-3)
    assert both["independent"].rms > 5


def test_pixels_of_a_perfect_image_have_the_noise_of_the_reference() -> None:
    """Rationale: noise that differs over the image and by wavelength. Expected: rms 1 for the expectation itself, and
    for a model that is off by as much as it states; larger for one that is off by what it does not state.
    """
    rng = np.random.default_rng(4)
    rows, columns = np.indices((90, 120))
    mask = np.hypot(rows - 45, columns - 60) < 40
    expected = np.stack([1 + 0.5 * np.sin(rows / 20), 0.3 + 0.001 * columns, np.full(rows.shape, 0.1)])
    deviation = 0.1 * expected * (1 + columns / 60)
    halves = expected + np.sqrt(2) * deviation * rng.standard_normal((2, *expected.shape))
    z = z_of_pixels(expected, 0 * expected, halves, mask)
    assert z.shape == (3, mask.sum())
    assert ZScores.of(z).rms == pytest.approx(1, abs=0.03)
    own = 0.2 * expected
    image = expected + own * rng.standard_normal(expected.shape)
    assert ZScores.of(z_of_pixels(image, own**2, halves, mask)).rms == pytest.approx(1, abs=0.03)
    assert ZScores.of(z_of_pixels(image, 0 * own, halves, mask)).rms > 1.3
    swapped = z_of_pixels(image, own**2, halves[::-1], mask)
    np.testing.assert_allclose(swapped, z_of_pixels(image, own**2, halves, mask), rtol=1e-12)
    scaled = z_of_pixels(1e-3 * image, 1e-6 * own**2, 1e-3 * halves, mask)
    np.testing.assert_allclose(scaled, swapped, rtol=1e-9)
    lonely = np.zeros_like(mask)
    lonely[10, 10] = lonely[50, 50] = True
    assert not np.isfinite(reference_variance(*halves, lonely)).any()
    assert ZScores.of(z_of_pixels(image, own**2, halves, lonely)) == ZScores(0, None, None)


def test_where_no_photon_came_there_is_no_z_score() -> None:
    """Rationale: entries that are zero in every replicate and have no variance in the model: nothing to divide by."""
    replicates, model = truth(0.05).replicates.copy(), EXACT[:, COLUMNS].copy()
    replicates[..., -5:], model[..., -5:] = 0.0, 0.0
    dark = replace(truth(), replicates=replicates)
    z = z_of_entries(model, 0 * model, dark)
    whole = z_of_entries(EXACT[:, COLUMNS], 0 * model, truth(0.05))
    assert 0 < sum(s.count for s in z.values()) < sum(s.count for s in whole.values())
    assert all(np.isfinite(s.rms) for s in z.values() if s.count)
    black = np.zeros((2, 3, 20, 20))
    assert ZScores.of(z_of_pixels(black[0], black[0], black, np.ones((20, 20), bool))).count == 0


def test_a_bright_pixel_does_not_disturb_the_noise_beside_it() -> None:
    """Rationale: ten decades in one image, as from behind. Expected: far from the bright pixel, the same variance."""
    rng = np.random.default_rng(5)
    halves = 1e-6 * rng.standard_normal((2, 1, 40, 60))
    mask = np.ones((40, 60), bool)
    alone = reference_variance(*halves, mask)
    halves[:, 0, 20, 20] = 1e4, -1e4
    both = reference_variance(*halves, mask)
    np.testing.assert_allclose(both[0, :, 40:], alone[0, :, 40:], rtol=1e-9)


def test_no_z_score_at_all() -> None:
    assert ZScores.of(np.array([np.nan])) == ZScores(0, None, None)


# ---- units, order, index


def test_units_and_the_order_of_vertices_change_nothing() -> None:
    """Rationale: the object turned is the same with its vertices in another order; in metres, M is a million times as
    large and areas a millionth.
    """
    rng = np.random.default_rng(5)
    order = rng.permutation(len(AREA))
    inverse = np.argsort(order)
    model = EXACT[:, COLUMNS] * rng.lognormal(0, 0.2, EXACT[:, COLUMNS].shape)
    variance = (0.2 * model) ** 2
    exact, beyond = truth(0.03), np.asarray(MESH.vertices)[:, 2] > 3.0
    turned = Truth(inverse[COLUMNS], exact.replicates[..., order], AREA[order], exact.balance)
    metres = Truth(COLUMNS, 1e6 * exact.replicates, 1e-6 * AREA, exact.balance)

    def everything(model: F64, variance: F64, exact: Truth, beyond: F64) -> list[float]:
        neck = score_neck({"own": model * exact.area}, exact, beyond)
        s = score_totals(model @ exact.area, exact, ALL)
        z = [*z_of_entries(model, variance, exact).values(), *z_of_totals(model, variance, exact, ALL).values()]
        shares = [x for own in neck.values() for x in (*own["truth"], *own["truth_se"], *own["methods"]["own"])]
        figures = [x for one in z if one.count for x in (one.rms, one.beyond_3)]
        return [*s.mean, *s.mean_se, *s.spread, *s.spread_se, *figures, *shares]

    plain = everything(model, variance, exact, beyond)
    np.testing.assert_allclose(
        everything(model[..., order], variance[..., order], turned, beyond[order]), plain, rtol=1e-9
    )
    np.testing.assert_allclose(everything(1e6 * model, 1e12 * variance, metres, beyond), plain, rtol=1e-9)


def test_true_totals_have_the_scatter_of_the_replicates_own_totals() -> None:
    """Rationale: entries of a replicate that are all too high together. Expected: the total is no better known than any
    of them; as a sum of independent entries it would be.
    """
    rng = np.random.default_rng(6)
    factor = 1 + 0.1 * rng.standard_normal((8, 3, len(COLUMNS), 1))
    alike = Truth(COLUMNS, EXACT[:, COLUMNS] * factor, AREA, truth().balance)
    mean, error = true_totals(alike)
    np.testing.assert_allclose(
        error / mean, factor.std(axis=0, ddof=1)[..., 0] / np.sqrt(8) / factor.mean(axis=0)[..., 0]
    )
