"""How well a relit image agrees with a reference that is itself a Monte Carlo estimate.

Two independent halves A and B of a reference have errors that are uncorrelated with each other, so that products such
as (I - A)(I - B) hold the model's error and not the reference's noise. Nothing is clipped: a model better than the
noise can show scores a little below zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hw.base.arrays import F64, Bool

BLOCK = 8  # pixels: noise is taken as uncorrelated between blocks of this size, and between nothing smaller


class Unscorable(ValueError):
    """The truth leaves nothing to compare with."""


@dataclass(frozen=True)
class RelitScore:
    """Of one relit image against one reference, pooled over object pixels and wavelengths.

    nrmse2:       <(I - A)(I - B)> / <A B>, signed
    nrmse2_se:    its standard error from the reference's noise (the pixels are given, not drawn)
    nrmse:        sign(nrmse2) sqrt|nrmse2|, with nrmse_se; tests against zero use nrmse2, whose error is Gaussian
    nrmse_floor:  what noise would have added in quadrature to the nrmse against the mean of A and B
    psnr:         dB, exposed to the 99th percentile, gamma 2.2; None where noise hides the error
    energy_ratio: <I> / <(A + B) / 2>
    """

    nrmse: float
    nrmse_se: float
    nrmse_floor: float
    psnr: float | None
    energy_ratio: float
    nrmse2: float
    nrmse2_se: float


def signed_root(square: float) -> float:
    """sign(x) sqrt|x|."""
    return math.copysign(math.sqrt(abs(square)), square)


def block_sums(values: F64, mask: Bool) -> F64:
    """(L, N) values on the mask's (H, W) pixels -> sums over wavelengths and BLOCK x BLOCK pixels, 1-D."""
    rows, columns = np.nonzero(mask)
    block = (rows // BLOCK) * (mask.shape[1] // BLOCK + 1) + columns // BLOCK
    return np.bincount(block, weights=values.sum(axis=0)).astype(np.float64)


def _tone(image: F64, exposure: float) -> F64:
    """Displayed value 0..1 of linear radiance: exposed, clipped, gamma 2.2."""
    return np.asarray(np.clip(image / exposure, 0.0, 1.0) ** (1 / 2.2))


def score_relit(image: ArrayLike, half_a: ArrayLike, half_b: ArrayLike, mask: Bool) -> RelitScore:
    """Scores of `image` against a reference in two independent halves.

    image, half_a, half_b: (L, H, W) linear radiance in W/(mm^2 sr); mask: (H, W), the object's pixels.

    The standard error uses the symmetry under exchange of A and B. With m the model minus the mean M of both and
    r = nrmse2, the sum over a block of (m + r M)(A - B) has mean zero and, for equal Gaussian noise, exactly the
    variance of the block's part of the numerator minus r times the denominator, correlations inside included.

    Raises: Unscorable where the mask or the reference leaves nothing to compare with.
    """
    i, a, b = (np.asarray(x, np.float64)[:, mask] for x in (image, half_a, half_b))
    if i.size == 0:
        raise Unscorable("the mask holds no pixel")
    mean, half = (a + b) / 2, (a - b) / 2
    denominator = float((a * b).sum())
    if denominator <= 0:
        raise Unscorable("the reference holds no light above its noise")
    nrmse2 = float(((i - a) * (i - b)).sum()) / denominator
    noise = block_sums((i - mean + nrmse2 * mean) * 2 * half, mask)
    nrmse2_se = float(np.sqrt((noise**2).sum())) / denominator
    root_se = 0.5 * (signed_root(nrmse2 + nrmse2_se) - signed_root(nrmse2 - nrmse2_se))  # defined at 0, too
    exposure = float(np.percentile(mean, 99.0))
    psnr = None
    if exposure > 0:
        ti, ta, tb = (_tone(x, exposure) for x in (i, a, b))
        square = float(((ti - ta) * (ti - tb)).mean())
        psnr = -10 * math.log10(square) if square > 0 else None
    return RelitScore(
        nrmse=signed_root(nrmse2),
        nrmse_se=root_se,
        nrmse_floor=math.sqrt(float((half**2).sum()) / denominator),
        psnr=psnr,
        energy_ratio=float(i.sum() / mean.sum()),
        nrmse2=nrmse2,
        nrmse2_se=nrmse2_se,
    )


def paired_difference(
    image: ArrayLike, other: ArrayLike, half_a: ArrayLike, half_b: ArrayLike, mask: Bool
) -> tuple[float, float]:
    """nrmse2 of `image` less that of `other` against the same reference, and its standard error from the reference's
    noise; negative where `image` is better.

    image, other, half_a, half_b: (L, H, W) linear radiance in W/(mm^2 sr); mask: (H, W), the object's pixels.

    The halves' product drops out, (I - A)(I - B) - (J - A)(J - B) = (I - J)(I + J - A - B): only where the two images
    differ does noise count, so that images that err alike are told apart far better than either score is known. What
    is left is the noise of the mean M of both halves; by the symmetry under exchange of A and B (see `score_relit`) a
    block's sum of (I - J + r M)(A - B) has mean zero and its variance, with r the difference itself, which stands for
    the noise of the denominator. Raises: Unscorable.
    """
    i, j, a, b = (np.asarray(x, np.float64)[:, mask] for x in (image, other, half_a, half_b))
    denominator = float((a * b).sum())
    if i.size == 0 or denominator <= 0:
        raise Unscorable("the mask holds no pixel, or the reference no light above its noise")
    difference = float(((i - j) * (i + j - a - b)).sum()) / denominator
    noise = block_sums((i - j + difference * (a + b) / 2) * (a - b), mask)
    return difference, float(np.sqrt((noise**2).sum())) / denominator


@dataclass(frozen=True)
class HalvesScore:
    """Of images that are themselves noisy, as two independent halves, against a reference. nrmse, nrmse_se: as in
    `RelitScore`, with no image's noise in them.
    """

    nrmse: float
    nrmse_se: float


def score_halves(images: ArrayLike, halves: ArrayLike, mask: Bool) -> HalvesScore:
    """nrmse^2 = <(I - A)(J - B)> / <A B> for halves I, J of the images and A, B of the reference.

    images, halves: (2, L, H, W) in W/(mm^2 sr); mask: (H, W). With means m = (I + J - A - B) / 2 and half differences
    d of the images and e of the reference, the product is m^2 - d^2 - e^2 once both ways to pair them are averaged; its
    standard error is that of `score_relit`, with the noise d - e.

    Raises: Unscorable as `score_relit`.
    """
    (i, j), (a, b) = (np.asarray(x, np.float64)[:, :, mask] for x in (images, halves))
    if i.size == 0:
        raise Unscorable("the mask holds no pixel")
    denominator = float((a * b).sum())
    if denominator <= 0:
        raise Unscorable("the reference holds no light above its noise")
    error, mean, d, e = (i + j - a - b) / 2, (a + b) / 2, (i - j) / 2, (a - b) / 2
    nrmse2 = float((error**2 - d**2 - e**2).sum()) / denominator
    noise = block_sums(2 * (error * (e - d) + nrmse2 * mean * e), mask)
    se2 = float(np.sqrt((noise**2).sum())) / denominator
    return HalvesScore(signed_root(nrmse2), 0.5 * (signed_root(nrmse2 + se2) - signed_root(nrmse2 - se2)))
