"""A rough dielectric surface: microfacets of the GGX distribution (Walter et al. 2007)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hw.base.arrays import F64
from pipeline.geometry.fresnel import transmittance

FACETS = 48  # per side of the square that the visible facets are drawn from


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


def rough_transmittance(cosine: ArrayLike, eta: float, alpha: float) -> F64:
    """Share of light transmitted by the facets, for (K,) cosines between the mean normal and the direction outside.

    By the midpoint rule over the facets that the direction sees (Heitz 2018), each weighted by what Fresnel lets
    through and by the share of it that leaves unshadowed (eq. 21, 23); what facets pass to each other is lost.
    """
    c = np.maximum(np.asarray(cosine, np.float64), 1e-6)[:, None]
    s = np.sqrt(1.0 - c**2)
    side = (np.arange(FACETS) + 0.5) / FACETS
    radius, turn = (a.reshape(1, -1) for a in np.meshgrid(np.sqrt(side), 2.0 * np.pi * side, indexing="ij"))
    # The direction, stretched by alpha, sees a hemisphere of facets as a disc; its lower half is seen obliquely.
    length = np.hypot(alpha * s, c)
    x, z = alpha * s / length, c / length
    across, up = radius * np.cos(turn), radius * np.sin(turn)
    up = 0.5 * (1.0 - z) * np.sqrt(1.0 - across**2) + 0.5 * (1.0 + z) * up
    towards = np.sqrt(np.maximum(1.0 - across**2 - up**2, 0.0))
    upward = np.maximum(x * up + z * towards, 1e-9)
    facet = np.stack([alpha * (x * towards - z * up), np.broadcast_to(alpha * across, up.shape), upward])
    facet /= np.linalg.norm(facet, axis=0)
    own = s * facet[0] + c * facet[2]
    within = np.sqrt(1.0 - (1.0 - own**2) / eta**2)
    down = c / eta - (own / eta - within) * facet[2]  # cosine of the refracted direction to the mean normal
    passed = transmittance(own, eta) * np.where(down > 0, smith(down, alpha), 0.0)
    return np.asarray(passed.mean(axis=1))
