"""Column totals, all light that leaves per light that arrives over one vertex, against those of the truth.

Broad light sees sums of entries: a method may be near the truth entry by entry and still be too bright or too dark. The
noise of the truth's totals is that of its replicates' own totals: entries that one photon makes do not vary apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from disco_twin.light.truth import Truth, standard_error
from hw.base.arrays import F64, Bool
from pipeline.reconstruct.samples.samples import Samples
from pipeline.relight.scores import signed_root


@dataclass(frozen=True)
class TotalsScore:
    """A model's totals over the truth's, by wavelength, over some columns; None where there are too few.

    columns: how many, black ones too, which have no ratio; mean: of the ratio; spread: its standard deviation relative
    to the mean, the truth's own noise removed (signed root); mean_se, spread_se: standard errors from the columns'
    scatter
    """

    columns: int
    mean: tuple[float | None, ...]
    mean_se: tuple[float | None, ...]
    spread: tuple[float | None, ...]
    spread_se: tuple[float | None, ...]


def true_totals(truth: Truth) -> tuple[F64, F64]:
    """(L, n) share of the light that arrives over each of the columns' vertices and leaves anywhere, and its standard
    error.
    """
    replicates = truth.replicates @ truth.area
    return replicates.mean(axis=0), standard_error(replicates)


def lit_vertices(samples: Samples) -> Bool:
    """(V,) vertices with a used spot in one of their triangles."""
    spots = samples.spots
    out = np.zeros(len(samples.mesh.vertices), bool)
    out[samples.mesh.faces[spots.triangle[spots.transmitted > 0]]] = True
    return out


def score_totals(totals: F64, truth: Truth, chosen: Bool) -> TotalsScore:
    """totals: (L, n) a model's; chosen: (n,) the columns that count."""
    exact, error = (x[:, chosen] for x in true_totals(truth))
    rows = []
    for own, true, noise in zip(totals[:, chosen], exact, error, strict=True):
        light = true > 0  # a wavelength may be absorbed wholly
        ratio = own[light] / true[light]
        rows.append(_one(ratio, ratio * noise[light] / true[light]))
    return TotalsScore(int(chosen.sum()), *zip(*rows, strict=True))


def _one(ratio: F64, noise: F64) -> tuple[float | None, float | None, float | None, float | None]:
    """(n,) ratios and what the truth's noise adds to their deviations -> mean, its error, spread, its error."""
    count = len(ratio)
    mean = float(ratio.mean()) if count else None
    if mean is None or mean <= 0 or count < 2:
        return mean, None, None, None
    scatter = float(ratio.var(ddof=1))
    own, own_se = scatter - float((noise**2).mean()), scatter * np.sqrt(2 / (count - 1))
    spread_se = 0.5 * (signed_root(own + own_se) - signed_root(own - own_se))
    return mean, float(np.sqrt(scatter / count)), signed_root(own) / mean, spread_se / mean
