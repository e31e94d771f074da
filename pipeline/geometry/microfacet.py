"""The reflection of a rough dielectric surface: microfacets of the GGX distribution (Walter et al. 2007)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hw.base.arrays import F64
from pipeline.geometry.fresnel import transmittance


def ggx(cosine: ArrayLike, alpha: float) -> F64:
    """Density of facets by the cosine between their normal and the surface's, per steradian (eq. 33)."""
    square = np.asarray(cosine, np.float64) ** 2
    return np.asarray(alpha**2 / (np.pi * (1.0 + square * (alpha**2 - 1.0)) ** 2))


def smith(cosine: ArrayLike, alpha: float) -> F64:
    """Share of the facets that are seen under a cosine to the surface's normal (eq. 34)."""
    square = np.maximum(np.asarray(cosine, np.float64), 1e-6) ** 2
    return np.asarray(2.0 / (1.0 + np.sqrt(1.0 + alpha**2 * (1.0 - square) / square)))


def reflected(half: F64, difference: F64, entering: F64, leaving: F64, eta: float, alpha: float) -> F64:
    """BRDF in 1/sr (eq. 20), for cosines (each of one shape) of the half vector to the normal, of either direction to
    the half vector, and of the directions in and out to the normal. No second reflection between facets.
    """
    fresnel = 1.0 - transmittance(difference, eta)
    shown = smith(entering, alpha) * smith(leaving, alpha)
    return np.asarray(fresnel * ggx(half, alpha) * shown / (4.0 * np.maximum(entering * leaving, 1e-6)))
