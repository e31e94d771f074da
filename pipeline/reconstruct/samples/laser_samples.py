"""One wavelength's samples beside what a model expects of them: residuals, weights, outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hw.base.arrays import F64, I64, Bool
from pipeline.reconstruct.samples.samples import ANGULAR, Samples

FAR_SCATTER = 0.3  # how the relative scatter of R_d about a smooth model grows with log(1 + edges / SCATTER_EDGES)
SCATTER_EDGES = 3.0
OUTLIER = 3.0  # standard deviations from which on a value counts less (Huber)
LARGEST_STEP = 2.0  # relative: what lies further from its expectation is taken to lie here


@dataclass(frozen=True)
class LaserSamples:
    """One laser's samples, (S, V) each.

    value: mm^-2, 0 where unobserved; observed; dark: variance without signal, mm^-4; noise: variance per signal, mm^-2;
    oblique: relative variance from obliqueness; edges: distance from spot to vertex in edges of the scan
    """

    value: F64
    observed: Bool
    dark: F64
    noise: F64
    oblique: F64
    edges: F64

    @classmethod
    def of(cls, samples: Samples, laser: int) -> LaserSamples:
        """One laser's part of the samples."""
        observed = np.isfinite(samples.values[laser])
        value, dark, noise = (
            np.where(observed, a[laser], 0.0).astype(np.float64)
            for a in (samples.values, samples.dark_variance, samples.noise_per_signal)
        )
        edges = samples.spot_pairs.distance / samples.edge
        return cls(value, observed, dark, noise, samples.oblique.astype(np.float64), edges)

    def at(self, spots: I64) -> LaserSamples:
        """Those of some spots."""
        value, dark, noise, oblique, edges = (
            a[spots] for a in (self.value, self.dark, self.noise, self.oblique, self.edges)
        )
        return LaserSamples(value, self.observed[spots], dark, noise, oblique, edges)

    def seen(self) -> LaserSamples:
        """What was observed alone, as a list: fields of (K,)."""
        value, dark, noise, oblique, edges = (
            a[self.observed] for a in (self.value, self.dark, self.noise, self.oblique, self.edges)
        )
        return LaserSamples(value, np.ones(len(value), bool), dark, noise, oblique, edges)

    def variance(self, expected: F64) -> F64:
        """Relative variance of a sample of this expectation by noise and obliqueness."""
        return np.asarray((self.dark + self.noise * expected) / expected**2 + self.oblique)

    def residual(self, expected: F64) -> tuple[F64, F64]:
        """Relative residual value / expected - 1 and its weight (0 where unobserved), outliers bounded.

        The bounds are symmetric in units of the noise: noise that drowns a signal must not raise it.
        """
        relative = np.where(self.observed, self.value / expected - 1.0, 0.0)
        deviation = np.sqrt(self.variance(expected) + scatter(self.edges) ** 2)
        weight = np.where(self.observed, 1.0 / deviation**2, 0.0)
        bound = np.maximum(LARGEST_STEP, OUTLIER * deviation)
        return np.clip(relative, -bound, bound), weight / np.maximum(np.abs(relative) / (OUTLIER * deviation), 1.0)


def scatter(edges: F64) -> F64:
    """Relative scatter of R_d about a smooth model, by distance in edges: direction, position, shape, detail."""
    return np.asarray(ANGULAR + FAR_SCATTER * np.log1p(edges / SCATTER_EDGES))
