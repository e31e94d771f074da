"""What R_d would be if the medium were the same everywhere: D and sigma_a fitted to the samples by Gauss-Newton.

It knows what distance alone does not: where an object is thin, necked or folded, and how that changes what arrives.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from hw.base.arrays import F64
from hw.base.errors import DiscoError
from pipeline.calibrate.least_squares import Linearised, Prior
from pipeline.reconstruct.medium.diffusion import Diffusion, Solver
from pipeline.reconstruct.medium.tetrahedra import NoMedium
from pipeline.reconstruct.samples.laser_samples import LaserSamples
from pipeline.reconstruct.samples.samples import Samples

log = logging.getLogger(__name__)

NEAREST = 2.5  # edges from a spot: nearer light has not diffused yet, nor do hat functions resolve it
FADE = (3.0, 6.0)  # edges between which the medium comes to say by what R_d departs from its mean at a distance
BINS = 40  # of distance, for that mean
MOST_SPOTS = 100
FEWEST = 500  # samples beyond NEAREST
ALIKE = 20.0  # samples next to each other err together: so many tell as much as one
START, SPREAD = (0.2, 5e-3), (1.5, 3.0)  # D and sigma_a in edges and per edge; by what their logarithms may differ
STEEPEST = 0.5  # fall over an edge: linear elements are then off by a hundredth of it, a tenth over ten edges' worth
DARKEST = 1e-12  # of the largest fluence rate: what is below are rounding errors
STEPS, ENOUGH, LONGEST = 12, 0.01, 1.5  # of the logarithms


@dataclass(frozen=True)
class HomogeneousMedium:
    """diffusivity: D in mm; absorption: sigma_a in 1/mm; level: of R_d over fluence rates"""

    diffusivity: float
    absorption: float
    level: float


def fit_medium(
    samples: Samples, laser: int, diffusion: Diffusion, start: HomogeneousMedium | None = None
) -> HomogeneousMedium:
    """The medium whose light between spots and vertices is nearest to one laser's samples. Raises: NoMedium."""
    used = np.flatnonzero(samples.spots.transmitted > 0)
    used = used[np.unique(np.linspace(0, len(used) - 1, MOST_SPOTS).round().astype(np.int64))] if len(used) else used
    measured = LaserSamples.of(samples, laser).at(used)
    seen = measured.observed & (measured.edges * samples.edge > NEAREST * diffusion.edge)
    if (count := int(seen.sum())) < FEWEST:
        raise NoMedium(f"{count} samples lie beyond {NEAREST} edges of their spots: {FEWEST} are needed")
    sources, on_surface = (samples.lit[used] @ diffusion.hats).toarray().T, len(diffusion.surface)
    before = np.array([np.log(START[0] * diffusion.edge), np.log(START[1] / diffusion.edge), 0.0])
    prior = Prior(before, np.diag([SPREAD[0] ** -2, SPREAD[1] ** -2, 0.0]))
    x = before if start is None else np.log([start.diffusivity, start.absorption, start.level])
    for step in range(STEPS):
        solver = _solver(diffusion, x)
        fluence = solver(sources)
        by_diffusivity = -np.exp(x[0]) * (diffusion.stiffness @ fluence)
        by_absorption = -np.exp(x[1]) * diffusion.mass[:, None] * fluence
        change = solver(np.concatenate([by_diffusivity, by_absorption], axis=1))
        nodes = np.concatenate([fluence, change], axis=1)[:on_surface]
        at_vertices = (diffusion.hats @ nodes).T.reshape(3, *seen.shape)
        mean = np.maximum(at_vertices[0], DARKEST * at_vertices[0].max())
        if step == 0 and start is None:
            bright = seen & (measured.value > 0)
            x = np.array([*x[:2], np.median(np.log(measured.value[bright] / mean[bright])) if bright.any() else 0.0])
        relative, weight = measured.residual(mean * np.exp(x[2]))
        followed = at_vertices[0] > DARKEST * at_vertices[0].max()
        weight = np.where(followed, weight, 0.0)  # what elements are too coarse for tells nothing
        if not weight[seen].any():
            raise NoMedium("no sample far from its spot is clear of the noise")
        slopes = np.where(weight > 0, at_vertices[1:] / mean, 0.0)
        jacobian = np.stack([slopes[0][seen], slopes[1][seen], np.ones(count)], axis=1)
        try:
            move = Linearised(x, -relative[seen], jacobian, weight[seen] / ALIKE, prior).step()
        except DiscoError:
            raise NoMedium("the samples leave D and sigma_a open") from None
        x = x + move * min(1.0, LONGEST / np.abs(move).max())
        # By what it does to the samples: where nothing absorbs, sigma_a itself is open.
        if np.sqrt(np.average((jacobian @ move) ** 2, weights=weight[seen])) < ENOUGH:
            log.info("medium: D %.3g mm, sigma_a %.2g/mm after %d steps", *np.exp(x[:2]), step + 1)
            break
    else:
        raise NoMedium(f"the fit of D and sigma_a had not converged after {STEPS} steps")
    if (fall := float(np.exp(0.5 * (x[1] - x[0]))) * diffusion.edge) > STEEPEST:
        raise NoMedium(
            f"light falls by exp(-{fall:.2f}) over an edge of the elements, which elements follow to {STEEPEST}"
        )
    return HomogeneousMedium(*np.exp(x).tolist())


def _solver(diffusion: Diffusion, x: F64) -> Solver:
    try:
        return diffusion.solver(*np.exp(x[:2]).tolist())
    except np.linalg.LinAlgError:
        raise NoMedium("the scan's inside cannot be filled with tetrahedra") from None


@dataclass(frozen=True)
class MediumPrior:
    """departures: (V, V) by what log R_d differs from its mean at a distance; at_spots: (S, V) the same from beams;
    totals: (V,) logarithm of what leaves for good of light that enters a hat function, of any level
    """

    departures: F64
    at_spots: F64
    totals: F64

    @classmethod
    def of(cls, samples: Samples, diffusion: Diffusion, medium: HomogeneousMedium) -> MediumPrior:
        """What a medium says of these samples' spots and vertices."""
        fluence, hats = diffusion.between(medium.diffusivity, medium.absorption), diffusion.hats
        known = fluence > DARKEST * fluence.max()
        logarithm = np.asarray(hats @ (hats @ np.log(np.where(known, fluence, 1.0))).T)
        known = np.asarray(hats @ (hats @ known.astype(np.float64)).T) > 1.0 - 1e-6  # all that it is interpolated from
        distance = samples.vertex_pairs.distance
        edges = np.quantile(distance, np.linspace(0, 1, BINS + 1))
        bin_of = np.clip(np.searchsorted(edges, distance) - 1, 0, BINS - 1).ravel()
        count = np.bincount(bin_of, known.ravel(), minlength=BINS)
        sums = (np.bincount(bin_of, (known * x).ravel(), minlength=BINS) for x in (distance, logarithm))
        at, level = (x[count > 0] / count[count > 0] for x in sums)
        place = np.clip((distance / diffusion.edge - FADE[0]) / (FADE[1] - FADE[0]), 0.0, 1.0)
        departures = (logarithm - np.interp(distance, at, level)) * (place**2 * (3.0 - 2.0 * place)) * known
        leaving = np.maximum(fluence, 0.0) @ diffusion.open_area
        totals = np.asarray(hats @ np.log(np.maximum(leaving, DARKEST * leaving.max())))
        return cls(departures, np.asarray(samples.lit @ departures), totals)
