"""The paired difference of two relit images' scores, on synthetic images whose errors are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.relight.scores import BLOCK, Unscorable, paired_difference, score_relit

F64 = NDArray[np.float64]
SHAPE = (3, 48, 64)
MASK = np.hypot(*(np.indices(SHAPE[1:]) - np.array([24, 32])[:, None, None])) < 21


def reference(rng: np.random.Generator) -> F64:
    return np.asarray(np.exp(rng.normal(0, 0.5, SHAPE)))


def test_without_noise_it_is_the_difference_of_the_squares() -> None:
    truth = reference(np.random.default_rng(0))
    difference, error = paired_difference(1.1 * truth, 0.8 * truth, truth, truth, MASK)
    assert difference == pytest.approx(0.1**2 - 0.2**2)
    assert error == 0
    again = paired_difference(0.8e-5 * truth, 1.1e-5 * truth, 1e-5 * truth, 1e-5 * truth, MASK)
    assert again[0] == pytest.approx(-difference)


def test_it_is_the_difference_of_both_scores_and_the_halves_may_change_places() -> None:
    rng = np.random.default_rng(1)
    truth = reference(rng)
    a, b = truth * (1 + 0.3 * rng.normal(0, 1, (2, *SHAPE)))
    one, other = 1.05 * truth, truth * (1 + 0.1 * rng.normal(0, 1, SHAPE))
    found = paired_difference(one, other, a, b, MASK)
    scores = [score_relit(image, a, b, MASK).nrmse2 for image in (one, other)]
    assert found[0] == pytest.approx(scores[0] - scores[1], rel=1e-9)
    assert paired_difference(one, other, b, a, MASK) == pytest.approx(found, rel=1e-9)


@pytest.mark.parametrize("noise_of", ["pixels", "blocks", "splats"])
@pytest.mark.parametrize("scale", [0.1, 0.4])
def test_its_standard_error_covers(noise_of: str, scale: float) -> None:
    """Rationale: many references of one truth, with noise that is independent, shared in a block by all wavelengths,
    or made of rare bright splats. Expected: the difference scatters about the noiseless one with the standard error
    that is stated, and a difference that is nothing is beyond three of them as rarely as that says.
    """
    rng = np.random.default_rng(2)
    truth = reference(rng)
    one = truth * (1 + 0.1 * rng.normal(0, 1, SHAPE))
    other = 1.08 * truth * (1 + 0.05 * rng.normal(0, 1, SHAPE))
    exact = paired_difference(one, other, truth, truth, MASK)[0]
    z = []
    for _ in range(400):
        if noise_of == "pixels":
            noise = rng.normal(0, 1, (2, *SHAPE))
        elif noise_of == "blocks":
            coarse = rng.normal(0, 1, (2, 1, SHAPE[1] // BLOCK, SHAPE[2] // BLOCK))
            noise = np.broadcast_to(coarse.repeat(BLOCK, 2).repeat(BLOCK, 3), (2, *SHAPE))
        else:
            noise = (rng.poisson(0.5, (2, *SHAPE)) - 0.5) / math.sqrt(0.5)
        a, b = truth * (1 + scale * noise)
        difference, error = paired_difference(one, other, a, b, MASK)
        z.append((difference - exact) / error)
    assert abs(np.mean(z)) < 4 * np.std(z) / math.sqrt(len(z))
    assert np.std(z) == pytest.approx(1, abs=0.25 if noise_of == "blocks" else 0.14)
    assert np.mean(np.abs(z) > 3) < 0.02


def test_the_error_grows_as_the_noise_and_shrinks_where_images_agree() -> None:
    rng = np.random.default_rng(3)
    truth = reference(rng)
    noise = rng.normal(0, 1, (2, *SHAPE))

    def error(step: float, scale: float) -> float:
        return paired_difference((1 + step) * truth, truth, *(truth * (1 + scale * noise)), MASK)[1]

    assert error(0.01, 0.02) == pytest.approx(2 * error(0.01, 0.01), rel=0.02)
    assert error(0.002, 0.02) == pytest.approx(0.2 * error(0.01, 0.02), rel=0.02)


def test_images_that_err_alike_are_told_apart_far_better_than_their_scores_are_known() -> None:
    rng = np.random.default_rng(4)
    truth = reference(rng)
    one = truth * (1 + 0.2 * rng.normal(0, 1, SHAPE))
    other = one * 1.01
    a, b = truth * (1 + 0.3 * rng.normal(0, 1, (2, *SHAPE)))
    _, error = paired_difference(one, other, a, b, MASK)
    assert error < 0.1 * min(score_relit(image, a, b, MASK).nrmse2_se for image in (one, other))


def test_refusals() -> None:
    ones = np.ones(SHAPE)
    with pytest.raises(Unscorable):
        paired_difference(ones, ones, ones, ones, np.zeros(SHAPE[1:], bool))
    with pytest.raises(Unscorable):
        paired_difference(ones, ones, ones, 0 * ones, MASK)
