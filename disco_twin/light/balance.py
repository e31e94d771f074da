"""Where the launched light went."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from hw.base.arrays import F64

log = logging.getLogger(__name__)

MOST_LOST = 1e-4  # of the launched power, in silence


@dataclass(frozen=True)
class EnergyBalance:
    """Mean fractions of the launched power per wavelength (L,), and their sum's departure from one.

    `reflected` never entered, and counts photons that missed the object too. `inside` is lost to images and deposits:
    of photons that were cut off, or that leaked from a mesh that is not watertight; `warn_of_loss` reports it.
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

    def warn_of_loss(self) -> None:
        """One line where more than MOST_LOST is `inside`."""
        lost = float((self.inside / np.maximum(self.launched, 1e-300)).max())
        if lost > MOST_LOST:
            log.warning(
                "%.2g of the launched power is lost, and images and R_d are too dark by as much: photons were still "
                "inside after very many meetings with the surface (is nothing absorbed?), or the mesh is not closed",
                lost,
            )
