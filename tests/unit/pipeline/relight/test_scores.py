"""Scores on synthetic images whose error is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

from pipeline.relight.scores import BLOCK, score_halves, score_relit, signed_root

F64 = NDArray[np.float64]
SHAPE = (3, 40, 48)
MASK = np.hypot(*(np.indices(SHAPE[1:]) - np.array([20, 24])[:, None, None])) < 17


def reference(rng: np.random.Generator) -> F64:
    return np.asarray(np.exp(rng.normal(0, 0.5, SHAPE)))


def test_without_noise_the_score_is_the_plain_formula() -> None:
    rng = np.random.default_rng(0)
    truth = reference(rng)
    model = truth * 1.1
    s = score_relit(model, truth, truth, MASK)
    assert s.nrmse == pytest.approx(0.1, rel=1e-12)
    assert (s.nrmse_se, s.nrmse_floor) == (0, 0)
    assert s.energy_ratio == pytest.approx(1.1)
    exposure = np.percentile(truth[:, MASK], 99)
    tone = [np.clip(x[:, MASK] / exposure, 0, 1) ** (1 / 2.2) for x in (model, truth)]
    assert s.psnr == pytest.approx(-10 * np.log10(((tone[0] - tone[1]) ** 2).mean()))
    dark = score_relit(np.zeros(SHAPE), truth, truth, MASK)
    assert dark.nrmse == pytest.approx(1)
    same = score_relit(truth, truth, truth, MASK)
    assert (same.nrmse, same.psnr) == (0, None)


def test_pixels_off_the_object_do_not_matter_and_neither_does_the_unit() -> None:
    rng = np.random.default_rng(1)
    truth, noise = reference(rng), rng.normal(0, 0.1, (2, *SHAPE))
    a, b, model = truth + noise[0], truth + noise[1], truth * 1.2
    before = score_relit(model, a, b, MASK)
    after = score_relit(1e-5 * (model + 100 * ~MASK), 1e-5 * (a - 7 * ~MASK), 1e-5 * b, MASK)
    assert after.nrmse == pytest.approx(before.nrmse, rel=1e-9)
    assert after.nrmse_se == pytest.approx(before.nrmse_se, rel=1e-9)
    assert after.psnr == pytest.approx(before.psnr, rel=1e-9)


def test_which_half_is_which_and_how_the_image_is_turned_does_not_matter() -> None:
    """Rationale: the object turned by a quarter or a half turn in the image, or seen in a mirror: the same pixels."""
    rng = np.random.default_rng(9)
    truth = reference(rng)
    a, b, model = truth + rng.normal(0, 0.1, SHAPE), truth + rng.normal(0, 0.1, SHAPE), 1.1 * truth
    before = score_relit(model, a, b, MASK)
    swapped = score_relit(model, b, a, MASK)
    mirrored = score_relit(*(x.swapaxes(1, 2) for x in (model, a, b)), MASK.T)
    half_turn = score_relit(*(x[:, ::-1, ::-1] for x in (model, a, b)), MASK[::-1, ::-1])
    for after in (swapped, mirrored, half_turn):
        for figure in ("nrmse", "nrmse_se", "nrmse_floor", "psnr", "energy_ratio"):
            assert getattr(after, figure) == pytest.approx(getattr(before, figure), rel=1e-9), figure


@pytest.mark.parametrize("correlated", [False, True])
@pytest.mark.parametrize("error", [0.0, 0.03, 0.3])
def test_unbiased_under_noise_with_an_honest_standard_error(error: float, correlated: bool) -> None:
    """Rationale: many references of one truth, noise of 30 %, independent or shared by all wavelengths of a block.
    Expected: nrmse2 scatters about the noiseless value with the standard error it states; the naive score does not.
    """
    rng = np.random.default_rng(2)
    truth = reference(rng)
    model = truth * (1 + error * rng.normal(0, 1, SHAPE))
    exact = score_relit(model, truth, truth, MASK).nrmse2
    z, naive = [], []
    for _ in range(300):
        if correlated:
            coarse = rng.normal(0, 1, (2, 1, SHAPE[1] // BLOCK, SHAPE[2] // BLOCK))
            noise = np.broadcast_to(coarse.repeat(BLOCK, 2).repeat(BLOCK, 3), (2, *SHAPE))
        else:
            noise = rng.normal(0, 1, (2, *SHAPE))
        a, b = truth * (1 + 0.3 * noise)
        s = score_relit(model, a, b, MASK)
        z.append((s.nrmse2 - exact) / s.nrmse2_se)
        naive.append(((model - (a + b) / 2)[:, MASK] ** 2).sum() / (a * b)[:, MASK].sum())
        assert naive[-1] == pytest.approx(s.nrmse2 + s.nrmse_floor**2, rel=1e-9)
    assert abs(np.mean(z)) < 4 * np.std(z) / math.sqrt(len(z))
    # The chi-squared spread of 300 deviates is 4 %; a dozen blocks' squares widen it for correlated noise.
    assert np.std(z) == pytest.approx(1, abs=0.45 if correlated else 0.17)
    if error < 0.1:
        assert np.mean(naive) > exact + 5 * np.std(naive) / math.sqrt(len(naive))


def test_energy_ratio_and_psnr_under_noise() -> None:
    rng = np.random.default_rng(3)
    truth = reference(rng)
    exact = score_relit(truth * 0.9, truth, truth, MASK)
    noisy = [score_relit(truth * 0.9, *(truth + rng.normal(0, 0.02, (2, *SHAPE))), MASK) for _ in range(20)]
    assert np.mean([s.energy_ratio for s in noisy]) == pytest.approx(exact.energy_ratio, rel=1e-3)
    assert np.mean([s.psnr for s in noisy if s.psnr]) == pytest.approx(exact.psnr, abs=0.3)


def test_noise_alone_scores_zero_within_its_error_and_may_be_negative() -> None:
    rng = np.random.default_rng(4)
    truth = reference(rng)
    scores = [score_relit(truth, *(truth * (1 + rng.normal(0, 0.5, (2, *SHAPE)))), MASK) for _ in range(100)]
    assert min(s.nrmse for s in scores) < 0 < max(s.nrmse for s in scores)
    assert all(math.isfinite(s.nrmse_se) and s.nrmse_se > 0 for s in scores)
    assert np.mean([abs(s.nrmse2) < 2.5 * s.nrmse2_se for s in scores]) > 0.92


def test_refusals() -> None:
    ones = np.ones(SHAPE)
    with pytest.raises(ValueError, match="no pixel"):
        score_relit(ones, ones, ones, np.zeros(SHAPE[1:], bool))
    with pytest.raises(ValueError, match="no light"):
        score_relit(ones, ones, 0 * ones, MASK)


@pytest.mark.parametrize("error", [0.0, 0.03, 0.3])
def test_noise_of_the_images_drops_out_as_well_with_an_honest_standard_error(error: float) -> None:
    """Rationale: images that are estimates themselves, 30 % noise on both sides. Expected: nrmse^2 scatters about the
    noiseless value with the standard error it states; images without noise have the score that `score_relit` gives.
    """
    rng = np.random.default_rng(5)
    truth = reference(rng)
    model = truth * (1 + error * rng.normal(0, 1, SHAPE))
    exact = score_relit(model, truth, truth, MASK).nrmse2
    z = []
    for _ in range(300):
        i, j, a, b = (x + 0.3 * truth * rng.normal(0, 1, SHAPE) for x in (model, model, truth, truth))
        score = score_halves(np.stack([i, j]), np.stack([a, b]), MASK)
        z.append((signed_square(score.nrmse) - exact) / nrmse2_se(score.nrmse, score.nrmse_se))
    assert abs(np.mean(z)) < 4 / np.sqrt(len(z))
    assert np.std(z) == pytest.approx(1, abs=0.25)
    alone = score_relit(model, a, b, MASK)
    assert score_halves(np.stack([model, model]), np.stack([a, b]), MASK).nrmse == pytest.approx(alone.nrmse)
    assert score_halves(np.stack([model, model]), np.stack([a, b]), MASK).nrmse_se == pytest.approx(alone.nrmse_se)


def signed_square(x: float) -> float:
    return x * abs(x)


def nrmse2_se(nrmse: float, se: float) -> float:
    """The standard error of nrmse^2 that `se` was made from."""

    def stated(se2: float) -> float:
        square = signed_square(nrmse)
        return 0.5 * (signed_root(square + se2) - signed_root(square - se2)) - se

    return float(brentq(stated, 0.0, 100.0))
