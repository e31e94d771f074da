"""The reflection of the surface, found in the samples near the spots and taken off them (docs/decisions/0123).

Where a camera looks near the mirror direction, a spot's centre is brighter than its surroundings say. How bright the
surroundings are, a few edges away, is known from samples that no reflection reaches. So, over all spots,

    log (near - strength * lobe(alpha)) = a + b log around + c (1 - cos in) + d (1 - cos out) + scatter,

each relative to the profile's expectation; c and d hold what rough boundaries let through, which is no lobe. All alphas
are tried. The strength is free within what transparent solids have: the index is an assumption, and of an index of 1.6
three times as much is reflected as of 1.3. What is not there beyond chance is left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from hw.base.arrays import F64, Bool
from pipeline.calibrate.least_squares import Huber, Prior, likeliest, minimise
from pipeline.geometry.mesh import RayMesh
from pipeline.reconstruct.global_term.radial_profile import LaserSamples, fit_profile
from pipeline.reconstruct.samples.samples import Samples
from pipeline.reconstruct.samples.surface_lobe import SurfaceLobe

ALPHAS = np.geomspace(0.05, 0.5, 15)  # a wider lobe cannot be told from what the boundary lets through
NORMAL, NORMAL_SPREAD = 0.042, 0.025  # reflectance of transparent solids at normal incidence (indices 1.3 to 1.7)
AROUND = (1.5, 4.0)  # edges from a spot, where its surroundings are read
WHOLE = 0.5  # share of the beam whose vertices must have been read
LEAST = 0.2  # of what is expected; a spot darker than that holds a fault
FEWEST = 30  # spots
MATCHED = 1e-3  # difference of the indices below which nothing is reflected
BY_CHANCE = 1e-3  # probability with which samples without a reflection show one
OUTLIER = Huber(2.0)  # standard deviations
PROFILES = 2  # fits of the profile, each without the reflection found before
SHAPE = 0.2  # relative: by how much a surface's lobe may differ from the fitted one


def subtract_reflection(samples: Samples) -> Samples:
    """The samples without what the surface reflects, and with what that leaves open in their variance."""
    lobe = fit_lobe(samples)
    if lobe.because:
        return samples.with_readings(lobe=lobe)
    one = _added(samples, lobe.alpha)
    open_part = (lobe.error**2 + (SHAPE * lobe.strength) ** 2) * one**2
    return samples.with_readings(
        values=(samples.values - lobe.strength * one).astype(np.float32),
        dark_variance=(samples.dark_variance + open_part).astype(np.float32),
        lobe=lobe,
    )


def fit_lobe(samples: Samples) -> SurfaceLobe:
    """Roughness and strength of the reflection; wavelengths together, since they share the surface.

    What is expected is a profile of the samples without the reflection: fitted twice, at first with it.
    """
    if samples.eta - 1 < MATCHED:
        return SurfaceLobe(because=f"of the assumed index, {samples.eta:g}, no light is reflected")
    grey, readings, found = _grey(samples), samples.read_in_beams, SurfaceLobe()
    count = len(np.unique(readings.spot[grey.observed[readings.spot, readings.vertex]]))
    if count < FEWEST:
        return _too_few(count)
    for _ in range(PROFILES):
        clean = replace(
            grey, value=np.where(grey.observed, grey.value - found.strength * _added(samples, found.alpha), 0.0)
        )
        fit = fit_profile(samples.spot_pairs, clean, samples.edge, samples.tilt)
        expected = samples.spot_pairs.mean(fit.profile) * fit.tilt.factor(samples.spot_pairs.distance, samples.tilt)
        found = _beyond(samples, grey, expected)
        if found.because:
            break
    return found


def _added(samples: Samples, alpha: float) -> F64:
    """(S, V) mm^-2, what a lobe of strength 1 adds to the samples; 0 for alpha 0."""
    out, readings = np.zeros(samples.values.shape[1:]), samples.read_in_beams
    if alpha > 0:
        np.add.at(out, (readings.spot, readings.vertex), samples.beams.in_samples(alpha))
    return out


def _beyond(samples: Samples, grey: LaserSamples, expected: F64) -> SurfaceLobe:
    """The lobe by which the samples exceed (S, V) `expected` near the spots."""
    area, beams, count = RayMesh.of(samples.mesh).vertex_areas, samples.beams, len(samples.spots.position)
    readings = beams.readings
    near = np.zeros(grey.observed.shape, bool)
    near[readings.spot, readings.vertex] = True
    near &= grey.observed
    around = grey.observed & ~near & (grey.edges > AROUND[0]) & (grey.edges < AROUND[1])

    def power(values: F64, where: Bool) -> F64:
        return np.asarray(np.where(where, values, 0.0) @ area)

    light = np.maximum(power(expected, near), 1e-30)
    shown = np.asarray((samples.lit.toarray() * near).sum(axis=1))
    at_centre = power(grey.value, near) / light
    surroundings = power(grey.value, around) / np.maximum(power(expected, around), 1e-30)
    leaving, entering = power(expected * samples.cosine, near) / light, _incidence(samples)
    used = (shown > WHOLE) & (samples.spots.transmitted > 0) & (at_centre > LEAST) & (surroundings > LEAST)
    if used.sum() < FEWEST:
        return _too_few(int(used.sum()))
    others = np.column_stack([np.ones(count), np.log(np.maximum(surroundings, LEAST)), 1 - entering, 1 - leaving])[used]
    weight = area[readings.vertex] * near[readings.spot, readings.vertex] / light[readings.spot]
    unit = ((samples.eta - 1.0) / (samples.eta + 1.0)) ** 2  # of the assumed index, by which strengths are counted
    centres, strengths = at_centre[used], (NORMAL / unit, NORMAL_SPREAD / unit)
    plain = np.linalg.lstsq(others, np.log(centres), rcond=None)[0]

    def with_alpha(alpha: float, scatter: float) -> _Regression:
        lobe = np.bincount(readings.spot, beams.in_samples(alpha) * weight, count)[used].astype(np.float64)
        return _regress(centres, others, lobe, strengths, plain, scatter)

    left = np.log(centres) - others @ plain
    for _ in range(2):  # the first time the reflection itself is part of the scatter
        scatter = max(1.4826 * float(np.median(np.abs(left))), 1e-3)
        tried = [with_alpha(alpha, scatter) for alpha in ALPHAS]
        log_alpha, spread = likeliest(np.log(ALPHAS), -np.array([one.gain for one in tried]))
        best = with_alpha(float(np.exp(log_alpha)), scatter)
        left = best.left
    limit = float(chi2.ppf(1 - BY_CHANCE, 2))
    if best.gain <= limit:
        why = f"spots are no brighter toward the mirror direction beyond their scatter (chi^2 at most {limit:.0f})"
        return SurfaceLobe(because=why)
    strength_by = np.gradient([one.strength for one in tried], np.log(ALPHAS))
    error = float(np.hypot(best.error, spread * np.interp(log_alpha, np.log(ALPHAS), strength_by)))
    return SurfaceLobe(float(np.exp(log_alpha)), best.strength, error)


def _too_few(spots: int) -> SurfaceLobe:
    return SurfaceLobe(because=f"{spots} spots were read where their beam met the object; {FEWEST} are needed")


def _incidence(samples: Samples) -> F64:
    """(S,) cosines of incidence."""
    return np.asarray(-(samples.spots.normal * samples.spots.direction).sum(axis=1))


def _grey(samples: Samples) -> LaserSamples:
    """Means over the lasers, where all were observed."""
    each = [LaserSamples.of(samples, laser) for laser in range(len(samples.values))]
    observed = np.logical_and.reduce([one.observed for one in each])
    n = len(each)
    value, dark, noise = (
        np.where(observed, sum(getattr(one, name) for one in each) / n**power, 0.0)
        for name, power in (("value", 1), ("dark", 2), ("noise", 2))
    )
    return LaserSamples(value, observed, dark, noise, each[0].oblique, each[0].edges)


@dataclass(frozen=True)
class _Regression:
    """strength; error: its standard error; gain: by how much chi^2 is less than without a lobe, 0 where the strength is
    not above 0; left: (S,) of the logarithms
    """

    strength: float
    error: float
    gain: float
    left: F64


def _regress(
    near: F64, smooth: F64, lobe: F64, strengths: tuple[float, float], start: F64, scatter: float
) -> _Regression:
    """near, lobe: (S,); smooth: (S, 4) of what the logarithm of the rest is linear in; strengths: mean and spread of
    those there are; start: (4,) without a lobe; scatter: of the logarithms.
    """
    n, (mean, spread) = smooth.shape[1], strengths

    def left(x: F64) -> F64:
        rest = np.maximum(near - x[n] * lobe, 0.1 * near)
        return np.asarray((np.log(rest) - smooth @ x[:n]) / scatter)

    def cost(x: F64) -> float:
        return float(OUTLIER.cost(left(x)).sum() + ((x[n] - mean) / spread) ** 2)

    prior = Prior(np.append(np.zeros(n), mean), np.diag(np.append(np.full(n, 1e-6), spread**-2)))
    bare = minimise(lambda x: left(np.append(x, 0.0)), start, Prior(np.zeros(n), 1e-6 * np.eye(n)), loss=OUTLIER)
    without, found = np.append(bare.value, 0.0), minimise(left, np.append(start, 0.0), prior, loss=OUTLIER)
    strength, error = float(found.value[n]), float(np.sqrt(found.covariance[n, n]))
    if strength <= 0:
        return _Regression(0.0, error, 0.0, scatter * left(without))
    return _Regression(strength, error, cost(without) - cost(found.value), scatter * left(found.value))
