"""R_d as a function of distance alone, fitted to the samples: the prior of the completion.

log f(r) is a cubic spline, so f is positive and smooth over many decades. The samples are never put into a logarithm:
noise makes the faint ones zero or negative. Instead the expectation mu = mean of f over beam and hat function is
fitted to the values by Gauss-Newton with the variance of the model's own mean (a quasi-likelihood with log link,
McCullagh & Nelder 1989, ch. 9), which averages noise linearly.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import block_diag

from hw.base.arrays import F64
from hw.base.errors import DiscoError
from hw.base.outcome import Outcome, Unsolved
from pipeline.calibrate.least_squares import Linearised, Prior
from pipeline.model.tilt import TiltLaw
from pipeline.reconstruct.samples.distances import Pairs
from pipeline.reconstruct.samples.laser_samples import LaserSamples
from pipeline.reconstruct.samples.samples import ANGULAR, Samples

log = logging.getLogger(__name__)

ITERATIONS = 12
TILT_EDGES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # where the tilt's slopes stand
TOO_MUCH = 1.0  # change, root mean square, with which it is no fit
ENOUGH = 0.1 * ANGULAR  # change of any sample's logarithm at which the fit ends


@dataclass(frozen=True)
class Profile:
    """log f(r) = sum of coefficients times cubic B-splines of r in mm; beyond the last knot it is constant."""

    knots: F64
    coefficients: F64

    def basis(self, distance: F64) -> F64:
        """(..., n) values of the B-splines."""
        inside = np.clip(np.asarray(distance, np.float64), self.knots[0], np.nextafter(self.knots[-1], 0))
        matrix = BSpline.design_matrix(inside.ravel(), self.knots, 3).toarray()
        return np.asarray(matrix.reshape(*np.shape(distance), -1))

    def __call__(self, distance: F64) -> F64:
        """f in mm^-2."""
        inside = np.clip(np.asarray(distance, np.float64), self.knots[0], np.nextafter(self.knots[-1], 0))
        return np.asarray(np.exp(BSpline(self.knots, self.coefficients, 3)(inside)))


def _knots(edge: float, largest: float) -> F64:
    """Knots in mm: as dense as the mesh resolves near zero, then in geometric steps."""
    inner = edge * np.array([0.25, 0.55, 0.9, 1.5, 2.2])
    outer = np.geomspace(3.0 * edge, max(largest, 4.5 * edge), 8)
    return np.concatenate([np.zeros(4), inner, outer[:-1], np.repeat(outer[-1], 4)])


def _start(profile: Profile, measured: LaserSamples, distance: F64) -> F64:
    """Coefficients through the logarithms of means over bins of distance. Raises: DiscoError where all is dark."""
    if not (measured.observed & (measured.value > 0)).any():
        seen = int(measured.observed.sum())
        remedy = "more light, longer exposures, spots that the cameras see"
        raise DiscoError(f"no light of a spot was seen: of {seen} samples none is above 0. Remedy: {remedy}")
    edges = np.quantile(distance[measured.observed], np.linspace(0, 1, 41))
    bin_of = np.clip(np.searchsorted(edges, distance) - 1, 0, 39)
    at, level = [], []
    for b in range(40):
        chosen = measured.observed & (bin_of == b)
        if chosen.any() and measured.value[chosen].mean() > 0:
            at.append(distance[chosen].mean())
            level.append(np.log(measured.value[chosen].mean()))
    if not at:
        raise DiscoError(
            "no light of the spots stands out of the noise: at no distance is the samples' mean above 0. Remedy: more "
            "light, or longer exposures"
        )
    basis = profile.basis(np.array(at))
    bend = np.diff(np.eye(basis.shape[1]), 2, axis=0)
    return np.asarray(np.linalg.solve(basis.T @ basis + 1e-2 * bend.T @ bend, basis.T @ np.array(level)))


@dataclass(frozen=True)
class ProfileFit:
    """profile: f; tilt: how single directions depart from it; covariance: (K, K) of the tilt's slopes"""

    profile: Profile
    tilt: TiltLaw
    covariance: F64


def fit_profile(
    pairs: Pairs,
    measured: LaserSamples,
    edge: float,
    tilt: F64,
    offset: F64 | float = 0.0,
    start: ProfileFit | None = None,
) -> ProfileFit:
    """Fit f and the tilt's slopes so that exp(offset + s tilt) (mean of f over the patches) meets the values.

    tilt: (S, V) of the samples; offset: (S, V) or 0; start: a first guess. f is the mean over all directions.

    Raises: DiscoError where all is dark; Unsolved where the fit is far from its end after so many steps.
    """
    knots = _knots(edge, float(pairs.distance.max()) * 1.01)
    if start is None:
        first = Profile(knots, _start(Profile(knots, np.zeros(len(knots) - 4)), measured, pairs.distance))
        profile, law = first, TiltLaw(edge * np.array(TILT_EDGES), np.zeros(len(TILT_EDGES)))
    else:
        profile, law = start.profile, start.tilt
    observed, seen = measured.observed, measured.seen()
    row = np.cumsum(observed).reshape(observed.shape) - 1  # of each observed pair among those that were
    near = observed[pairs.first, pairs.second]
    near_row, histogram = row[pairs.first[near], pairs.second[near]], pairs.histogram[near]
    near_basis, n = profile.basis(pairs.centres), len(profile.coefficients)
    leaning = law.basis(pairs.distance[observed], law.distance) * tilt[observed][:, None]
    jacobian = np.concatenate([profile.basis(pairs.distance[observed]), leaning], axis=1)
    given = np.broadcast_to(offset, observed.shape)[observed]
    slopes = _bend(len(law.slope)) + np.eye(len(law.slope))  # where nothing leans, they are 0
    prior = Prior(np.zeros(n + len(law.slope)), block_diag(_bend(n), slopes))
    for _ in range(ITERATIONS):
        mean = pairs.mean(profile)[observed]
        change = histogram @ (profile(pairs.centres)[:, None] * near_basis)
        jacobian[near_row, :n] = change / mean[near_row, None]
        relative, weight = seen.residual(mean * np.exp(given + leaning @ law.slope))
        now = np.concatenate([profile.coefficients, law.slope])
        linear = Linearised(now, -relative, jacobian, weight, prior)
        step = linear.step()
        step *= min(1.0, 2.0 / np.abs(step).max())
        profile, law = Profile(knots, now[:n] + step[:n]), replace(law, slope=now[n:] + step[n:])
        if np.abs(jacobian @ step).max() < ENOUGH:
            break
    else:
        # By weight: where nothing but noise is seen, a profile may go on falling for ever.
        if not weight @ (jacobian @ step) ** 2 < TOO_MUCH**2 * weight.sum():
            raise Unsolved("the fit of R_d by distance", Outcome.STOPPED, ITERATIONS, "more spots, or more light")
        log.warning("the profile's fit was stopped after %d steps, before it converged", ITERATIONS)
    # A spot's samples err together: where it lies, the object around it.
    covariance = linear.covariance @ (linear.scatter(np.nonzero(observed)[0]) + prior.precision) @ linear.covariance
    return ProfileFit(profile, law, covariance[n:, n:])


def _bend(n: int) -> F64:
    """(n, n) precision of second differences of unit variance."""
    second = np.diff(np.eye(n), 2, axis=0)
    return np.asarray(second.T @ second)


def plain_profile(samples: Samples, laser: int) -> ProfileFit:
    """`fit_profile` to one laser's samples as they are, worked out once for all who start from it."""
    key = "plain profile", laser
    if key not in samples.shared:
        measured = LaserSamples.of(samples, laser)
        samples.shared[key] = fit_profile(samples.spot_pairs, measured, samples.edge, samples.tilt)
    found: ProfileFit = samples.shared[key]
    return found


def over_directions(samples: Samples, laser: int) -> tuple[LaserSamples, Profile]:
    """One laser's samples with the tilt taken out, and the profile: what the simple models are fitted to.

    They have no directions; a mean over those that the cameras happened to look from would be too low.
    """
    measured, distance = LaserSamples.of(samples, laser), samples.spot_pairs.distance
    fit = plain_profile(samples, laser)
    return replace(measured, value=measured.value / fit.tilt.factor(distance, samples.tilt)), fit.profile
