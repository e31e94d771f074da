"""The reflection of the surface, found in the samples near the spots and taken off them (docs/decisions/0123).

Where a camera looks near the mirror direction, a spot's centre is brighter than its surroundings say. How bright the
surroundings are, a few edges away, is known from samples that no reflection reaches. So, over all spots,

    log (near - strength * lobe(alpha)) = a + b log around + c (1 - cos in) + d (1 - cos out) + scatter,

each relative to the profile's expectation; c and d hold what rough boundaries let through, which is no lobe. All alphas
and strengths are tried, and each counts by its likelihood. The strength is free within what translucent solids have:
the index is an assumption, and of an index of 1.6 three times as much is reflected as of 1.3. What is not there beyond
chance is left out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtri  # scipy.stats takes most of a second to import

from hw.base.arrays import F64, Bool
from pipeline.calibrate.least_squares import Huber
from pipeline.geometry.mesh import RayMesh
from pipeline.reconstruct.global_term.boundary_fit import MATCHED
from pipeline.reconstruct.global_term.radial_profile import fit_profile
from pipeline.reconstruct.samples.laser_samples import LaserSamples
from pipeline.reconstruct.samples.samples import Samples
from pipeline.reconstruct.samples.surface_lobe import SurfaceLobe

ALPHAS = np.geomspace(0.05, 0.5, 15)  # a wider lobe cannot be told from what the boundary lets through
REFLECTANCES = np.linspace(0.0, 0.12, 49)  # at normal incidence, that are tried
NORMAL, NORMAL_SPREAD = 0.035, 0.015  # those of translucent solids and liquids: indices of 1.3 to 1.6
AROUND = (1.5, 4.0)  # edges from a spot, where its surroundings are read
WHOLE = 0.5  # share of the beam whose vertices must have been read
LEAST = 0.2  # of what is expected; a spot darker than that holds a fault
FEWEST = 30  # spots
BY_CHANCE = 1e-7  # probability with which samples without a reflection show one; angles that are no lobe's gain less
OUTLIER = Huber(2.0)  # standard deviations
ROUNDS = 8  # of weights
PROFILES = 2  # fits of the profile, each without the reflection found before
SHAPE = 0.2  # relative: by how much a surface's lobe may differ from the fitted one


def subtract_reflection(samples: Samples) -> Samples:
    """The samples without what the surface reflects, and with what that leaves open in their variance.

    What it leaves open is one error for all spots, and is added to every sample's own variance: sums of samples come
    out a little too sure. `glow` keeps the reflection, since images do. Raises: DiscoError as `fit_lobe`.
    """
    lobe = fit_lobe(samples)
    if lobe.because:
        return samples.with_readings(lobe=lobe)
    reflected = _added(samples, lobe)
    open_part = ((lobe.error / lobe.strength) ** 2 + SHAPE**2) * reflected**2
    return samples.with_readings(
        values=(samples.values - reflected).astype(np.float32),
        dark_variance=(samples.dark_variance + open_part).astype(np.float32),
        lobe=lobe,
    )


def fit_lobe(samples: Samples) -> SurfaceLobe:
    """Roughness and strength of the reflection; wavelengths together, since they share the surface.

    What is expected is a profile of the samples without the reflection: fitted twice, at first with it. Raises:
    DiscoError where values are not finite.
    """
    if samples.eta - 1 < MATCHED:
        return SurfaceLobe(because=f"of the assumed index, {samples.eta:g}, no light is reflected")
    grey, readings, found = _grey(samples), samples.read_in_beams, SurfaceLobe()
    count = len(np.unique(readings.spot[grey.observed[readings.spot, readings.vertex]]))
    if count < FEWEST:
        return _too_few(count)
    for _ in range(PROFILES):
        reflected = _added(samples, found)
        clean = replace(grey, value=np.where(grey.observed, grey.value - reflected, 0.0))
        fit = fit_profile(samples.spot_pairs, clean, samples.edge, samples.tilt)
        expected = samples.spot_pairs.mean(fit.profile) * fit.tilt.factor(samples.spot_pairs.distance, samples.tilt)
        found = _beyond(samples, grey, expected)
        if found.because:
            break
    return found


def _added(samples: Samples, lobe: SurfaceLobe) -> F64:
    """(S, V) mm^-2, what a lobe adds to the samples."""
    out, readings = np.zeros(samples.values.shape[1:]), samples.read_in_beams
    np.add.at(out, (readings.spot, readings.vertex), lobe.in_samples(samples.beams))
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
    strengths = REFLECTANCES / unit
    lobes = [np.bincount(readings.spot, beams.in_samples(a) * weight, count)[used].astype(np.float64) for a in ALPHAS]
    cost, gain = _tried(at_centre[used], others, lobes, strengths)
    limit = float(chdtri(2, BY_CHANCE))
    if gain <= limit:
        why = f"spots are no brighter toward the mirror direction beyond their scatter (chi^2 at most {limit:.0f})"
        return SurfaceLobe(because=why)
    cost = cost + ((REFLECTANCES - NORMAL) / NORMAL_SPREAD) ** 2
    share = np.exp(-0.5 * (cost - cost.min()))
    share /= share.sum()
    mean = float((share * strengths).sum())
    error = float(np.sqrt((share * (strengths - mean) ** 2).sum()))
    kept = share @ strengths  # of each alpha, by what it is worth
    return SurfaceLobe(tuple(map(float, ALPHAS)), tuple(map(float, kept)), error)


def _too_few(spots: int) -> SurfaceLobe:
    return SurfaceLobe(because=f"{spots} spots were read where their beam met the object; {FEWEST} are needed")


def _incidence(samples: Samples) -> F64:
    """(S,) cosines of incidence."""
    return np.asarray(-(samples.spots.normal * samples.spots.direction).sum(axis=1))


def _grey(samples: Samples) -> LaserSamples:
    """Means over the lasers that saw anything, where all of them did."""
    all_lasers = [LaserSamples.of(samples, laser) for laser in range(len(samples.values))]
    each = [one for one in all_lasers if one.observed.any()] or all_lasers[:1]
    observed = np.logical_and.reduce([one.observed for one in each])
    n = len(each)
    value, dark, noise = (
        np.where(observed, sum(getattr(one, name) for one in each) / n**power, 0.0)
        for name, power in (("value", 1), ("dark", 2), ("noise", 2))
    )
    return LaserSamples(value, observed, dark, noise, each[0].oblique, each[0].edges)


def _tried(near: F64, smooth: F64, lobes: list[F64], strengths: F64) -> tuple[F64, float]:
    """(A, K) -2 log likelihood of every alpha and strength, and by how much the least is below that of no lobe.

    near: (S,); smooth: (S, 4) of what the logarithm of near - strength * lobe is linear in; lobes: A of (S,);
    strengths: (K,), the first 0
    """
    scatter = _scatter(np.log(near) - smooth @ np.linalg.lstsq(smooth, np.log(near), rcond=None)[0])
    for _ in range(2):  # the first time the reflection itself is part of the scatter
        found = [_costs(near, smooth, lobe, strengths, scatter) for lobe in lobes]
        cost = np.stack([c for c, _ in found])
        alpha, strength = np.unravel_index(int(np.argmin(cost)), cost.shape)
        scatter = _scatter(found[int(alpha)][1][int(strength)])
    return cost, float(cost[0, 0] - cost.min())


def _scatter(left: F64) -> float:
    """Standard deviation, from the median, of what is left."""
    return max(1.4826 * float(np.median(np.abs(left))), 1e-3)


def _costs(near: F64, smooth: F64, lobe: F64, strengths: F64, scatter: float) -> tuple[F64, F64]:
    """(K,) -2 log likelihood with robust weights, and (K, S) what is left of the logarithms.

    What scatters is the light from below the surface, so its density in `near` has 1 / (near - strength * lobe) in it;
    without that, a lobe would be found too weak.
    """
    rest = np.maximum(near - strengths[:, None] * lobe, 0.1 * near)
    target: F64 = np.log(rest)
    left, weight = target, np.ones_like(target)
    for _ in range(ROUNDS):
        normal = (smooth.T * weight[:, None]) @ smooth + 1e-9 * len(near) * np.eye(smooth.shape[1])
        right = (smooth.T * (weight * target)[:, None]).sum(axis=2)
        left = np.asarray(target - np.linalg.solve(normal, right[..., None])[..., 0] @ smooth.T, np.float64)
        weight = OUTLIER.weight(left.ravel() / scatter).reshape(left.shape)
    cost = OUTLIER.cost(left.ravel() / scatter).reshape(left.shape).sum(axis=1) + 2 * np.log(rest / near).sum(axis=1)
    return np.asarray(cost), np.asarray(left)
