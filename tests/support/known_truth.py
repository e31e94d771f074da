"""A truth whose exitance is known, with noise of known size in independent replicates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from disco_twin.light.balance import EnergyBalance
from disco_twin.light.truth import Truth

F64 = NDArray[np.float64]
REPLICATES = 8


def made_truth(exact: F64, columns: F64, area: F64, noise: float, seed: int = 0, replicates: int = REPLICATES) -> Truth:
    """The truth's columns of (L, V, V) exitance in mm^-2 with relative noise of their mean; area: (V,) mm^2."""
    draw = np.random.default_rng(seed).standard_normal((replicates, *exact[:, columns].shape))
    entries = exact[:, columns] * (1 + noise * np.sqrt(replicates) * draw)
    nothing = np.zeros(len(exact))
    balance = EnergyBalance(**dict.fromkeys(EnergyBalance.__dataclass_fields__, nothing))
    return Truth(columns, entries, area, balance)


def exitance(points: F64, lengths: tuple[float, ...] = (2.0, 2.3, 2.6)) -> F64:
    """(L, V, V) mm^-2, symmetric, falling over four decades."""
    distance = np.linalg.norm(points[:, None] - points, axis=2)
    return np.stack([np.exp(-distance / length) / length**2 / 10 for length in lengths])
