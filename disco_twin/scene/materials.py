"""Measured materials: reduced scattering and absorption of Jensen et al. 2001, table 1."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hw.base.arrays import F64

CHANNELS_NM = (635.0, 532.0, 476.0)  # which laser stands for the table's red, green and blue

# name: (sigma_s' for R, G, B, sigma_a for R, G, B) in 1/mm
MATERIALS: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "marble": ((2.19, 2.62, 3.00), (0.0021, 0.0041, 0.0071)),
    "skin1": ((0.74, 0.88, 1.01), (0.032, 0.17, 0.48)),
    "whole-milk": ((2.55, 3.21, 3.77), (0.0011, 0.0024, 0.014)),
    "skim-milk": ((0.70, 1.22, 1.90), (0.0014, 0.0025, 0.0142)),
    "cream": ((7.38, 5.47, 3.15), (0.0002, 0.0028, 0.0163)),
    "ketchup": ((0.18, 0.07, 0.03), (0.061, 0.97, 1.45)),
    "apple": ((2.29, 2.39, 1.97), (0.0030, 0.0034, 0.046)),
    "potato": ((0.68, 0.70, 0.55), (0.0024, 0.0090, 0.12)),
}


def measured(name: str, wavelengths_nm: Sequence[float]) -> tuple[F64, F64]:
    """(L,) sigma_t in 1/mm and (L,) albedo of a material at each laser, taken from the nearest of R, G and B.

    By similarity sigma_s' stands for sigma_s with g = 0, so sigma_t = sigma_s' + sigma_a.
    """
    distance = np.abs(np.subtract.outer(np.asarray(wavelengths_nm, float), np.array(CHANNELS_NM)))
    channel = np.argmin(distance, axis=1)
    scatter, absorb = (np.array(values)[channel] for values in MATERIALS[name])
    return scatter + absorb, scatter / (scatter + absorb)
