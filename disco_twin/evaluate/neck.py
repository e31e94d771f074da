"""Head and body: of the light that arrives on one side of the object's neck, the share that leaves on the other.

The neck of the duck in the thesis (figure 6.6) is a border for global light transport; a model that fills what it did
not see by distance alone lets too much light cross it. By reciprocity as much light crosses in either direction, but
the sides differ in area.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from disco_twin.light.truth import Truth, standard_error
from hw.base.arrays import F64, Bool


def crossing(leaving: F64, area: F64, entered: Bool, other: Bool) -> F64:
    """(..., L) share of the light that arrives evenly over some vertices' areas, and leaves on the other side.

    leaving: (..., L, n, V) share of the light that arrives over each column's vertex, and leaves over every vertex;
    area: (n,) of the columns' hat functions in mm^2; entered: (n,) the columns of one side; other: (V,) the other side
    """
    crossed = leaving[..., entered, :][..., other].sum(axis=-1)
    return np.asarray(crossed @ area[entered] / area[entered].sum())


def score_neck(models: Mapping[str, F64], truth: Truth, beyond: Bool) -> dict[str, Any]:
    """By direction across the neck, along its normal or against it: how many columns, the truth's share by wavelength
    with its standard error, and the share of every model. Without a column on the one side there is no share.

    models: by method, (L, n, V) share of the light that leaves (`RelightableModel.leaving`); beyond: (V,) the vertices
    on the side that the normal points to
    """
    here = beyond[truth.columns]
    area = truth.area[truth.columns]
    out = {}
    for direction, entered, other in (("along_normal", ~here, beyond), ("against_normal", here, ~beyond)):
        own: dict[str, Any] = {"columns": int(entered.sum()), "truth": None, "truth_se": None, "methods": {}}
        if entered.any():
            shares = crossing(truth.replicates * truth.area, area, entered, other)
            own["truth"], own["truth_se"] = shares.mean(axis=0).tolist(), standard_error(shares).tolist()
            own["methods"] = {m: crossing(x, area, entered, other).tolist() for m, x in models.items()}
        out[direction] = own
    return out
