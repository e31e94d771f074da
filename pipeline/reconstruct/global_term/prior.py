"""What R_d is expected to be before single entries are looked at, and by how much it may depart from that.

By distance alone; and by a medium that is the same everywhere, where the samples say that it helps.
"""

from __future__ import annotations

import logging

import numpy as np

from hw.base.arrays import F64
from pipeline.reconstruct.global_term.radial_profile import fit_profile, plain_profile
from pipeline.reconstruct.medium.diffusion import Diffusion
from pipeline.reconstruct.medium.medium_fit import HomogeneousMedium, MediumPrior, fit_medium
from pipeline.reconstruct.medium.tetrahedra import NoMedium
from pipeline.reconstruct.samples.laser_samples import LaserSamples
from pipeline.reconstruct.samples.samples import Samples

log = logging.getLogger(__name__)

# Chosen by leaving a fifth of the spots out, without the truth (docs/decisions/0013); lengths in edges of the scan.
NEAR, FAR, TURN_EDGES = 0.08, 0.6, 3.6  # s(distance): relative deviation of R_d from its prior
BETWEEN = (3.0, 8.0)  # edges: where the samples tell how far R_d departs from its prior
CLEAR, FEWEST, LEAST_RATIO = 0.04, 200, 1e-3  # relative variance by noise, number of samples, ratio that count there
LEAST_FAR = 0.15
WORTH = 0.9  # a medium has to make that scatter smaller by a tenth


def deviation(edges: F64, far: float) -> F64:
    """s: standard deviation of log R_d about its prior, by distance in edges; at most `far`."""
    return np.minimum(NEAR + (FAR - NEAR) * -np.expm1(-((edges / TURN_EDGES) ** 2)), far)


def far_scatter(samples: Samples, laser: int, at_spots: F64 | None = None) -> float:
    """Of the logarithms of an object's own samples, far from their spots, about their prior: without their noise.

    at_spots: (S, V) `MediumPrior.at_spots`, or None. NaN where too few samples are clear of the noise.
    """
    measured, pairs = LaserSamples.of(samples, laser), samples.spot_pairs
    if at_spots is None:
        fit = plain_profile(samples, laser)
    else:
        fit = fit_profile(pairs, measured, samples.edge, samples.tilt, at_spots)
    expected = pairs.mean(fit.profile) * fit.tilt.factor(pairs.distance, samples.tilt)
    if at_spots is not None:
        expected *= np.exp(at_spots)
    far = measured.observed & (measured.edges > BETWEEN[0]) & (measured.edges < BETWEEN[1])
    noise = measured.variance(expected)
    clear = far & (noise < CLEAR)
    if clear.sum() < FEWEST:
        return np.nan
    miss = np.log(np.maximum(measured.value[clear] / expected[clear], LEAST_RATIO))
    scatter = 1.4826 * np.median(np.abs(miss - np.median(miss)))  # of a normal distribution, from its middle half
    return float(np.sqrt(max(scatter**2 - noise[clear].mean(), 0.0)))


def medium_priors(samples: Samples) -> tuple[list[MediumPrior], float, str]:
    """One for each laser, none where a medium does not help; what `deviation` comes to far from a spot (the scatter of
    the middle wavelength, which stands for all, in bounds); and why there is none.
    """
    middle = len(samples.values) // 2
    alone = _credited(far_scatter(samples, middle), np.inf)
    try:
        diffusion, found = Diffusion.of(samples.mesh, samples.eta), list[HomogeneousMedium]()
        for laser in range(len(samples.values)):
            found.append(fit_medium(samples, laser, diffusion, found[-1] if found else None))
    except NoMedium as why:
        return [], _credited(alone), str(why)
    prior = MediumPrior.of(samples, diffusion, found[middle])
    far = _credited(far_scatter(samples, middle, prior.at_spots), np.inf)
    log.info("log R_d scatters by %.3f about distance alone, by %.3f about a homogeneous medium", alone, far)
    if np.isnan(alone + far):
        return [], _credited(alone), "too few samples far from their spots are clear of the noise to tell"
    if not far < WORTH * alone:
        because = f"log R_d scatters by {far:.2f} about a homogeneous one, by {alone:.2f} about distance alone"
        return [], _credited(alone), because
    others = {k: MediumPrior.of(samples, diffusion, m) for k, m in enumerate(found) if k != middle}
    return [others.get(k, prior) for k in range(len(found))], _credited(far), ""


def _credited(scatter: float, most: float = FAR) -> float:
    """In bounds; where nothing is known, NaN, or `most` if that is finite."""
    return most if np.isnan(scatter) and np.isfinite(most) else float(np.clip(scatter, LEAST_FAR, most))
