"""Column totals with a prior of their own: broad light sees sums of entries.

Entries that nothing was measured near are off by tens of per cent, and alike within a column: its total may come out
at twice of what arrives. Totals themselves vary slowly over the surface, and more light than arrives does not leave. So
the logarithm of every vertex's total is kriged over the surface, each with the deviation that its column states: what
was measured keeps its total, what was not takes its neighbours'. Then each vertex has one factor, on its row and its
column alike, so that R_d stays symmetric and its sums meet those totals (docs/decisions/0121).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import erfcx  # scipy.stats takes most of a second to import

from hw.base.arrays import F64
from hw.base.errors import InputError
from hw.base.outcome import Outcome, Unsolved
from pipeline.reconstruct.global_term.harmonics import Harmonics

log = logging.getLogger(__name__)

RANGES = (1.5, 2.5, 4.0, 6.0, 10.0)  # edges: correlation lengths that are tried
DEVIATIONS = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32)  # of the totals' logarithms over the surface, likewise
COMMON = (0.02, 0.04, 0.08)  # what the samples of one spot have in common, likewise
SHARED, SHARED_RANGE = 0.08, 6.0  # what errors of scan and poses do to totals, and over how many edges alike
ENOUGH = 1e-4  # relative change of a factor at which the scaling ends
STEPS = 200
FAR_ABOVE = 1e4  # deviations
DARKEST = 1e-6  # share of what arrives that leaves where nothing seems to
TOO_MUCH = 10.0  # times the light that arrives, in the median column: no noise, but another unit of power


@dataclass(frozen=True)
class ObservedField:
    """A field's observations at V places. functions: (V, n) U; noise: (V,) variances"""

    functions: F64
    noise: F64

    @cached_property
    def weighted(self) -> F64:
        """(V, n) noise^-1 U."""
        return np.asarray(self.functions / self.noise[:, None])

    @cached_property
    def told(self) -> F64:
        """(n, n) U^T noise^-1 U: what they tell of the coefficients."""
        return np.asarray(self.functions.T @ self.weighted)


@dataclass(frozen=True)
class Kriging:
    """A Gaussian field z = mean + U a, a ~ N(0, diag(spectrum)), observed with an error U b, b ~ N(0, diag(shared)),
    that is smooth itself, and with a noise of its own.

    seen: the observations' noise and what they tell of U's coefficients; spectrum, shared: (n,)
    """

    seen: ObservedField
    spectrum: F64
    shared: F64

    @property
    def functions(self) -> F64:
        """(V, n) U."""
        return self.seen.functions

    def posterior(self, observed: F64) -> tuple[F64, F64]:
        """(V,) mean and variance of z given the observations (Rasmussen & Williams 2006, eq. 2.25, 2.26; its mean by
        generalised least squares).
        """
        both, (factor, level, pull, _) = self.spectrum + self.shared, self._solved(observed)
        mean = level + self.functions @ (self.spectrum * (self.functions.T @ pull))
        # Of a + b the observations leave the inverse of what was factored; a is its share of that, and what b hides.
        part = self.functions * (self.spectrum / both)
        variance = (part * cho_solve(factor, part.T).T).sum(axis=1)
        variance += (self.functions**2 * (self.spectrum * self.shared / both)).sum(axis=1)
        return np.asarray(mean), np.asarray(variance)

    def likelihood(self, observed: F64) -> float:
        """Logarithm of that of the observations, but for a constant."""
        _, level, pull, size = self._solved(observed)
        return float(-0.5 * ((observed - level) @ pull + size))

    def _solved(self, observed: F64) -> tuple[tuple[F64, bool], float, F64, float]:
        """The factored precision of a + b; the level; (V,) inverse covariance times the rest; and log determinant."""
        weighted, noise, both = self.seen.weighted, self.seen.noise, self.spectrum + self.shared
        factor = cho_factor(self.seen.told + np.diag(1.0 / both))

        def whitened(x: F64) -> F64:
            return np.asarray(x / noise - weighted @ cho_solve(factor, weighted.T @ x))

        one = np.ones(len(observed))
        level = float((whitened(one) @ observed) / (whitened(one) @ one))
        size = 2 * np.log(np.diag(factor[0])).sum() + np.log(both).sum() + np.log(noise).sum()
        return factor, level, whitened(observed - level), float(size)


def steady_totals(
    reflectance: F64,
    variance: F64,
    open_area: F64,
    exitance_per_flux: float,
    basis: Harmonics,
    edge: float,
    expected: F64 | None = None,
) -> F64:
    """(L, V, V) R_d whose column totals are steadied, symmetric as before.

    reflectance: (L, V, V) mm^-2; variance: relative, of what the fill leaves open; open_area: (V,) mm^2 of the hats,
    times the share of what leaves there that leaves for good; exitance_per_flux: Tbar^2, by which sums
    of R_d are what leaves of what arrives; edge: mm; expected: (L, V) logarithms of the totals of a model of the whole
    object, of any level, or None

    Raises: InputError for samples by which far more light leaves than arrives.
    """
    share = reflectance * open_area
    total = share.sum(axis=2)
    _require_possible(total * exitance_per_flux)
    dark = total <= 0  # nothing leaves: the neighbours' totals say more
    total = np.where(dark, 1.0 / exitance_per_flux, total)
    open_deviation = (share * np.sqrt(variance)).sum(axis=2) / total  # errors of a column are alike: they simply add up
    # More than arrives cannot leave: a column that says so is off by at least as much.
    excess = np.where(dark, -np.log(DARKEST), np.maximum(np.log(total * exitance_per_flux), 0.0))
    # Errors that neighbours share cannot be told from the object where nothing is known of its totals' shape.
    shape, size = (np.zeros_like(total), 0.0) if expected is None else (expected, SHARED)
    known = np.log(total * exitance_per_flux) - shape
    shared = _spectrum(basis, SHARED_RANGE * edge, size)

    @cache  # for all lengths and deviations
    def seen(laser: int, common: float) -> ObservedField:
        return ObservedField(basis.functions, open_deviation[laser] ** 2 + excess[laser] ** 2 + common**2)

    def field(laser: int, choice: tuple[float, float, float]) -> Kriging:
        length, deviation, common = choice
        return Kriging(seen(laser, common), _spectrum(basis, length * edge, deviation), shared)

    choices = list(product(RANGES, DEVIATIONS, COMMON))
    middle = len(known) // 2  # one wavelength tells the lengths of all
    best = max(choices, key=lambda choice: field(middle, choice).likelihood(known[middle]))
    log.info("totals: correlated over %g edges, by %g; %g of a spot's own", *best)
    out = np.empty_like(reflectance)
    for laser, own in enumerate(reflectance):
        mean, spread = field(laser, best).posterior(known[laser])
        wanted = np.exp(at_most_zero(mean + shape[laser], np.sqrt(spread))) / exitance_per_flux
        try:
            factor = scaling(own, open_area, wanted)
        except Unsolved as why:
            log.warning("laser %d: %s; its column totals stay as they were", laser, why)
            factor = np.ones(len(open_area))
        out[laser] = factor[:, None] * own * factor
    return out


def _require_possible(leaving: F64) -> None:
    """leaving: (L, V) of what arrives. Raises: InputError where no noise explains it."""
    worst = float(np.median(leaving, axis=1).max())
    if worst > TOO_MUCH:
        raise InputError(
            f"the samples give back {worst:.3g} times the light that arrived", key="photodiode_w",
            allowed=f"up to {TOO_MUCH:g} times, as a median over the surface",
            remedy="state powers in watts, and the camera's responsivity per W/(mm^2 sr)",
        )  # fmt: skip


def _spectrum(basis: Harmonics, range_mm: float, deviation: float) -> F64:
    """(n,) variances of a field's coefficients."""
    spectrum = 1.0 / basis.roughness(range_mm)
    return np.asarray(deviation**2 * spectrum / spectrum.sum())


def at_most_zero(mean: F64, deviation: F64) -> F64:
    """Expectation of a normal variable that is known to be at most 0."""
    size = np.maximum(deviation, 1e-300)
    with np.errstate(over="ignore"):  # far below the bound, where nothing is taken off
        inner = mean - size * np.sqrt(2.0 / np.pi) / erfcx(mean / (np.sqrt(2.0) * size))
    far = mean > FAR_ABOVE * deviation  # the two cancel there: the tail's first order
    return np.where(far, -(deviation**2) / np.where(far, mean, 1.0), inner)


def scaling(reflectance: F64, area: F64, wanted: F64) -> F64:
    """(V,) g for which g_u sum_v R_uv g_v A_v = wanted_u (Sinkhorn and Knopp 1967, for symmetric matrices).

    reflectance: (V, V) symmetric, not negative; area, wanted: (V,). A row of zeros keeps its factor. Raises: Unsolved
    where no factors are found.
    """
    factor = np.ones(len(area))
    for _ in range(STEPS):
        total = factor * (reflectance @ (factor * area))
        change = np.sqrt(np.divide(wanted, total, out=np.ones_like(total), where=total > 0))
        factor *= change
        if np.abs(change - 1).max() < ENOUGH:
            return factor
    raise Unsolved("the scaling of column totals", Outcome.STOPPED, STEPS)
