"""How well entries of exitance per irradiance agree with the truth, decade by decade, without the truth's own noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hw.base.arrays import F64
from pipeline.relight.scores import Unscorable, signed_root

DECADES = 4


@dataclass(frozen=True)
class DecadeScore:
    """Of estimated entries against the truth, over those whose truth lies in one decade below the peak.

    decade:      0 for (peak/10, peak], -1 for the next, ...
    log10_rmse:  root mean square of log10(estimate / truth) over the covered entries, the truth's own noise removed
                 (signed root); log10_bias: the mean; None where no entry is covered
    coverage:    share of the decade's entries that the estimate covers
    entries:     number of entries of the decade
    """

    decade: int
    log10_rmse: float | None
    log10_bias: float | None
    coverage: float
    entries: int


def below_peak(truth: F64, truth_se: F64) -> F64:
    """(L, n, V) decades that each entry of the truth lies below its wavelength's peak, 0 at the peak; infinite where
    the truth is known to worse than a half.

    Raises: Unscorable where no entry is known.
    """
    usable = (truth > 0) & (truth_se < 0.5 * truth)
    if not usable.any():
        raise Unscorable("no entry of the truth is known to better than a half")
    peak = np.where(usable, truth, 0.0).max(axis=(1, 2), keepdims=True)
    return np.where(usable, np.log10(peak / np.where(usable, truth, 1.0)), np.inf)


def score_entries(
    estimate: ArrayLike, truth: ArrayLike, truth_se: ArrayLike, covered: ArrayLike, decades: int = DECADES
) -> tuple[DecadeScore, ...]:
    """log10_rmse per decade below the peak of each wavelength, wavelengths pooled.

    estimate, truth, truth_se: (L, n, V) in mm^-2; covered: bool, broadcast to the same shape. A covered estimate that
    is not positive counts as one decade off. Entries whose truth is known to worse than a half are left out.

    Raises: Unscorable where those are all.
    """
    e, t, se = (np.asarray(x, np.float64) for x in (estimate, truth, truth_se))
    seen = np.broadcast_to(np.asarray(covered, bool), t.shape)
    below = below_peak(t, se)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.where(e > 0, np.log10(e / t), -1.0)
        noise2 = (se / (t * math.log(10))) ** 2
    scores = []
    for decade in range(decades):
        of_decade = (below >= decade) & (below < decade + 1)
        chosen = of_decade & seen
        entries, count = int(np.count_nonzero(of_decade)), int(np.count_nonzero(chosen))
        removed = float(noise2[chosen].mean()) if count else 0.0
        scores.append(
            DecadeScore(
                decade=-decade,
                log10_rmse=signed_root(float((off[chosen] ** 2).mean()) - removed) if count else None,
                log10_bias=float(off[chosen].mean()) if count else None,
                coverage=count / entries if entries else 0.0,
                entries=entries,
            )
        )
    return tuple(scores)
