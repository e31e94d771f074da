"""Unpolarised Fresnel transmittance of a smooth dielectric, from air into a medium of relative index eta >= 1.

By reciprocity the same factor holds on the way out, as a function of the direction outside (thesis eq. 2.1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from hw.base.arrays import F64

_NEAR_GRAZING = (1e-4, 1e-3, 1e-2, 0.1)  # F_t rises over a range of sqrt(eta^2 - 1) in the cosine


@dataclass(frozen=True)
class Boundary:
    """A surface whose transmittance departs from the smooth one: `ratio` at `cosines` (ascending), linear between.

    A rough surface transmits more at grazing angles than a smooth one of the same index.
    """

    eta: float
    cosines: tuple[float, ...] = (1.0,)
    ratio: tuple[float, ...] = (1.0,)

    @cached_property
    def mean_transmittance(self) -> float:
        """Tbar = (1 / pi) integral F_t cos dw over the hemisphere, to ten digits.

        The smooth mean in closed form, and what the ratio adds to it by Gauss's rule between the ratio's corners.
        """
        last = self.ratio[-1]
        corners = np.unique(np.clip([0.0, *_NEAR_GRAZING, *self.cosines, 1.0], 0.0, 1.0))
        low, high = corners[:-1, None], corners[1:, None]
        nodes, weights = np.polynomial.legendre.leggauss(24)
        c = 0.5 * (low + high + (high - low) * nodes)
        added = (np.interp(c, self.cosines, self.ratio) - last) * transmittance(c, self.eta) * 2.0 * c
        return float(last * mean_transmittance(self.eta) + (0.5 * (high - low) * weights * added).sum())


def transmittance(cosine: ArrayLike, eta: float | Boundary) -> F64:
    """F_t: flux transmitted, for the cosine between the outward normal and the direction outside.

    Same shape as `cosine`; 0 at and below the horizon (cosine <= 0), 1 everywhere above it for eta = 1. `eta` is the
    relative index of a smooth boundary, or a measured `Boundary`.
    """
    if isinstance(eta, Boundary):
        c = np.asarray(cosine, np.float64)
        return np.asarray(transmittance(c, eta.eta) * np.interp(c, eta.cosines, eta.ratio))
    if eta < 1:
        raise ValueError(f"relative index {eta} < 1: the light comes from the thinner side")
    outside = np.clip(np.asarray(cosine, np.float64), 0.0, 1.0)
    inside = np.sqrt((eta**2 - 1.0) + outside**2) / eta
    # T = 1 - R written without the subtraction, which would lose all digits near grazing incidence.
    with np.errstate(invalid="ignore"):
        s = 4 * eta * outside * inside / (outside + eta * inside) ** 2
        p = 4 * eta * outside * inside / (inside + eta * outside) ** 2
    return np.asarray(np.where(outside > 0, 0.5 * (s + p), 0.0))


def mean_transmittance(eta: float) -> float:
    """Tbar = 2 * integral_0^1 F_t(c) c dc, the mean over a Lambertian hemisphere; 0.939 for eta = 1.3.

    Closed form: one minus the external diffuse reflectance of Egan & Hilgeman 1979 (Walsh 1926, eq. 1).
    """
    if eta < 1:
        raise ValueError(f"relative index {eta} < 1: the light comes from the thinner side")
    if eta - 1 < 1e-4:
        return 1.0 - (eta - 1) / 3.0  # first order, right to 4e-8; the closed form cancels here
    m, m2, m4 = eta, eta**2, eta**4
    reflectance = (
        0.5
        + (m - 1) * (3 * m + 1) / (6 * (m + 1) ** 2)
        + m2 * (m2 - 1) ** 2 / (m2 + 1) ** 3 * math.log((m - 1) / (m + 1))
        - 2 * m**3 * (m2 + 2 * m - 1) / ((m2 + 1) * (m4 - 1))
        + 8 * m4 * (m4 + 1) / ((m2 + 1) * (m4 - 1) ** 2) * math.log(m)
    )
    return 1.0 - reflectance


def along_surface(direction: F64, normal: F64, eta: float) -> F64:
    """(..., 3) the part along the surface of the refracted direction of travel, of length sin(theta) / eta (Snell).

    direction: unit, of travel outside, in or out; normal: unit. The part is the same on both ways through.
    """
    return np.asarray((direction - (direction * normal).sum(axis=-1, keepdims=True) * normal) / eta)
