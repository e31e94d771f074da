"""What a surface lets through and reflects: indices from 1 to 2.4, roughness from .02 to 1, grazing light."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import log

import numpy as np
from scipy.integrate import quad

from benchmarks.stability.case import Ends, Family, relative
from hw.base.arrays import F64
from pipeline.geometry import microfacet
from pipeline.geometry.fresnel import mean_transmittance, transmittance
from pipeline.geometry.microfacet import ggx, reflected, rough_transmittance
from pipeline.reconstruct.global_term.boundary_fit import rough_boundary

FAMILY = Family("surface")
GRAZING = np.array([1e-12, 1e-9, 1e-6, 1e-3, 0.1, 0.5, 1.0])
INDICES = (1.0, 1.0 + 1e-9, 1.0001, 1.3, 2.4)


def reference(cosine: F64, eta: float) -> F64:
    """Transmittance as 1 - R in extended precision, R by Fresnel's amplitudes."""
    c, n = np.asarray(cosine, np.longdouble), np.longdouble(eta)
    inside = np.sqrt((n * n - 1) + c * c) / n
    s, p = (c - n * inside) / (c + n * inside), (n * c - inside) / (n * c + inside)
    return np.asarray(1 - 0.5 * (s * s + p * p), np.float64)


def naive(cosine: F64, eta: float) -> F64:
    """The textbook's 1 - R in single precision."""
    c, n = np.asarray(cosine, np.float32), np.float32(eta)
    inside = np.sqrt(1 - (1 - c * c) / n**2)
    s, p = (c - n * inside) / (c + n * inside), (n * c - inside) / (n * c + inside)
    return np.asarray(1 - 0.5 * (s * s + p * p), np.float64)


def transmittance_off(formula: Callable[[F64, float], F64], eta: float) -> float:
    return relative(formula(GRAZING, eta), reference(GRAZING, eta))


for eta in INDICES:
    FAMILY.case(
        f"transmittance down to grazing light, index {eta:.10g}",
        "1 - R in extended precision",
        "cosines 1e-12 .. 1",
        1e-6,
        rivals={"1 - R in single precision": partial(transmittance_off, naive, eta)},
    )(partial(transmittance_off, transmittance, eta))


def mean_by_quadrature(eta: float) -> float:
    corner = np.sqrt(max(eta**2 - 1, 0.0))
    points = sorted({p for p in (1e-6, 1e-4, 1e-2, corner, 10 * corner) if 0 < p < 1})
    total = 0.0
    for low, high in zip([0.0, *points], [*points, 1.0], strict=True):
        total += quad(lambda c: 2 * c * float(transmittance(c, eta)), low, high, epsabs=1e-13, epsrel=1e-12)[0]
    return total


def closed_form(eta: float) -> float:
    """Egan and Hilgeman 1979 as it is printed: it cancels near 1."""
    m, m2, m4 = eta, eta**2, eta**4
    return 1 - (
        0.5
        + (m - 1) * (3 * m + 1) / (6 * (m + 1) ** 2)
        + m2 * (m2 - 1) ** 2 / (m2 + 1) ** 3 * log((m - 1) / (m + 1))
        - 2 * m**3 * (m2 + 2 * m - 1) / ((m2 + 1) * (m4 - 1))
        + 8 * m4 * (m4 + 1) / ((m2 + 1) * (m4 - 1) ** 2) * log(m)
    )


def mean_off(formula: Callable[[float], float], eta: float) -> float:
    return relative(formula(eta), mean_by_quadrature(eta))


for eta in (1.0 + 1e-7, 1.0 + 1e-5, 1.0001, 1.00011, 1.001, 2.4):
    FAMILY.case(
        f"mean transmittance, index {eta:.9g}",
        "the integral over the hemisphere, by quadrature",
        f"eta - 1 = {eta - 1:.1e}",
        1e-7,
        rivals={"the printed closed form": partial(mean_off, closed_form, eta)},
    )(partial(mean_off, mean_transmittance, eta))


def facets_converged(alpha: float, eta: float = 1.3) -> float:
    """Against ten times as many facets in either direction."""
    cosines = np.array([0.01, 0.05, 0.2, 0.5, 0.9, 1.0])
    found, count = rough_transmittance(cosines, eta, alpha), microfacet.FACETS
    try:
        microfacet.FACETS = 10 * count
        return relative(found, rough_transmittance(cosines, eta, alpha))
    finally:
        microfacet.FACETS = count


def projected_off(alpha: float) -> float:
    """By how much the facets' projected area misses the surface's."""
    points = [alpha, 10 * alpha] if 10 * alpha < 1.5 else None

    def around(t: float) -> float:
        return float(2 * np.pi * np.sin(t) * np.cos(t) * ggx(np.cos(t), alpha))

    return abs(float(quad(around, 0, np.pi / 2, points=points, epsrel=1e-10, limit=500)[0]) - 1)


for alpha in (0.02, 0.3, 1.0):
    FAMILY.case(
        f"a rough surface lets through, alpha {alpha:g}",
        "the quadrature over facets has converged",
        "cosines .01 .. 1",
        2e-3,
        slow=alpha > 0.02,
    )(partial(facets_converged, alpha))
    FAMILY.case(
        f"facets project to the surface, alpha {alpha:g}",
        "integral of D cos over the hemisphere is 1",
        f"peak {1 / (np.pi * alpha**2):.2g} / sr",
        1e-6,
    )(partial(projected_off, alpha))


@FAMILY.case("a lobe at grazing angles", "reciprocal and finite down to a cosine of 1e-6", "alpha .02", 1e-12)
def grazing_lobe() -> float:
    low, half = np.array([1e-6, 1e-3, 0.1]), np.array([0.5, 0.9, 1.0])
    one = reflected(half, half, low, np.full(3, 0.7), 2.4, 0.02)
    return relative(one, reflected(half, half, np.full(3, 0.7), low, 2.4, 0.02))


def roughness_found(alpha: float) -> float:
    """Largest error of the fitted curve, relative, where views are not grazing."""
    cosines = np.linspace(0.05, 0.95, 14)
    exact = rough_transmittance(cosines, 1.3, alpha) / transmittance(cosines, 1.3)
    found = rough_boundary(1.3, cosines, exact)
    shown = np.interp(cosines, found.cosines, found.ratio)
    return relative((shown / shown[-1])[2:], (exact / exact[-1])[2:])


for alpha in (0.02, 0.64):
    FAMILY.case(
        f"the boundary's curve from images, alpha {alpha:g}",
        "the curve that made them",
        "ends of what is tried",
        0.05,
        slow=True,
    )(partial(roughness_found, alpha))


@FAMILY.case(
    "the boundary's curve from noise alone",
    "within a factor of 3 of a smooth surface",
    "errors of 100 %",
    3.0,
    slow=True,
)
def from_noise() -> float:
    rng = np.random.default_rng(0)
    found = rough_boundary(1.3, np.linspace(0.05, 0.95, 14), np.exp(rng.standard_normal(14)))
    return float(np.exp(np.abs(np.log(np.interp(np.linspace(0.2, 1, 20), found.cosines, found.ratio))).max()))


@FAMILY.case(
    "a scene's rough boundary of index 1.0001", "refused: too near to no boundary", "eta 1.0001", ends=Ends.REFUSED
)
def nearly_matched() -> float:
    from benchmarks.stability.material import scene_with

    scene_with({"object.boundary.eta": 1.0001})
    return 0.0
