"""z-scores: errors over the deviations that model and truth state together (docs/z-scores.md).

Where the stated variances are right, a z-score's rms is 1 and three in a thousand lie beyond 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from disco_twin.evaluate.entries import DECADES, below_peak
from disco_twin.evaluate.totals import true_totals
from disco_twin.light.truth import Truth
from hw.base.arrays import F64, Bool

Array = NDArray[np.floating]
WINDOW = 9  # pixels and axis over which the noise of a reference is taken to be alike
LEAST = 5  # pixels of a window that have to show the object


@dataclass(frozen=True)
class ZScores:
    """Of `count` z-scores: root mean square, and the share beyond 3; None where there is none."""

    count: int
    rms: float | None
    beyond_3: float | None

    @classmethod
    def of(cls, z: F64) -> ZScores:
        """Of all that are finite."""
        z = z[np.isfinite(z)]
        if not z.size:
            return cls(0, None, None)
        return cls(z.size, float(np.sqrt((z**2).mean())), float((np.abs(z) > 3).mean()))


def over(error: Array, variance: Array) -> F64:
    """error / sqrt(variance), NaN where there is none: no photon came, or nothing is known of how many might."""
    deviation = np.sqrt(variance, dtype=np.float64)
    out: F64 = np.full(deviation.shape, np.nan)
    np.divide(error, deviation, out=out, where=(deviation > 0) & np.isfinite(deviation))
    return out


def honest(variance: F64, freedom: int | F64) -> F64:
    """A variance estimated with so many degrees of freedom, raised so that what is divided by it has the mean square
    1 (the variance of Student's t); infinite where two or fewer tell nothing.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.asarray(freedom) > 2, variance * np.divide(freedom, np.subtract(freedom, 2.0)), np.inf)


def z_of_entries(mean: Array, variance: Array, truth: Truth) -> dict[str, ZScores]:
    """(Tbar^2 R_d - M) / sqrt(var(Tbar^2 R_d) + var(M)) by decade of the truth M.

    mean, variance: (L, n, V) Tbar^2 R_d in mm^-2 and its variance. Entries whose truth is known to worse than a half
    are left out. Raises: Unscorable where those are all.
    """
    noise = honest(truth.standard_error**2, len(truth.replicates) - 1)
    z = over(mean - truth.mean, variance + noise)
    below = below_peak(truth.mean, truth.standard_error)
    return {str(-d): ZScores.of(z[(below >= d) & (below < d + 1)]) for d in range(DECADES)}


def z_of_totals(mean: Array, variance: Array, truth: Truth, chosen: Bool) -> dict[str, ZScores]:
    """The same of column totals over some (n,) columns, the entries' errors taken as `independent` and as `alike`.

    What a model states of its entries does not determine the variance of their sum: errors that know nothing of each
    other make the smallest that can be expected, errors that are all of one sign the largest.
    """
    exact, error = true_totals(truth)
    noise = honest(error**2, len(truth.replicates) - 1)
    off = mean @ truth.area - exact
    variances = {"independent": variance @ truth.area**2, "alike": (np.sqrt(variance) @ truth.area) ** 2}
    return {name: ZScores.of(over(off, v + noise)[:, chosen]) for name, v in variances.items()}


def z_of_pixels(image: Array, variance: Array, halves: Array, mask: Bool) -> F64:
    """(L, N) z-scores of a relit image in the mask's pixels: (image - mean of the halves) / sqrt(both variances).

    image, variance: (L, H, W) radiance in W/(mm^2 sr), and the model's variance of it, which knows nothing of the error
    of eq. 2.1 itself; halves: (2, L, H, W) of the reference
    """
    a, b = np.asarray(halves, np.float64)
    return over(image - 0.5 * (a + b), variance + reference_variance(a, b, mask))[:, mask]


def reference_variance(a: F64, b: F64, mask: Bool) -> F64:
    """(L, H, W) variance of the mean of two halves, from their difference over the object's pixels around each pixel.

    Infinite where those are fewer than `LEAST`.
    """

    def around(values: F64) -> F64:
        out, weights = np.where(mask, values, 0.0), np.full(WINDOW, 1.0 / WINDOW)
        for axis in (-2, -1):  # no running sum, whose rounding would trail behind bright pixels
            out = convolve1d(out, weights, axis, mode="constant")
        return np.asarray(out)

    share = around(np.ones(mask.shape))
    count = np.rint(share * WINDOW**2)
    mean = around(((a - b) / 2) ** 2) / np.maximum(share, 1e-12)
    return np.where(count >= LEAST, honest(mean, count), np.inf)
