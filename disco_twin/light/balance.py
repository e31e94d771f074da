"""Where the launched light went."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class EnergyBalance:
    """Mean fractions of the launched power per wavelength (L,), and their sum's departure from one.

    `reflected` never entered, and counts photons that missed the object too.
    launched + roulette = reflected + escaped + absorbed + boundary + inside, up to rounding.
    """

    launched: F64
    reflected: F64
    escaped: F64
    absorbed: F64
    boundary: F64
    roulette: F64
    inside: F64

    @property
    def residual(self) -> F64:
        """What the terms leave unexplained, as a share of the launched power; rounding only."""
        out = self.reflected + self.escaped + self.absorbed + self.boundary + self.inside
        return np.asarray((self.launched + self.roulette - out) / self.launched)
