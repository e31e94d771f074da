"""Baseline: an opaque surface. Light leaves where it enters; the albedo is a spot's total energy."""

from __future__ import annotations

import numpy as np

from hw.base.arrays import F64
from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.mesh import RayMesh
from pipeline.model.lambertian import LambertianTerm
from pipeline.model.relightable import RelightableModel
from pipeline.reconstruct.global_term.completion import MOST_HARMONICS, RANGE_EDGES
from pipeline.reconstruct.global_term.harmonics import harmonics
from pipeline.reconstruct.global_term.radial_profile import over_directions
from pipeline.reconstruct.registry import method
from pipeline.reconstruct.samples.samples import Samples

ALBEDO_NOISE = 0.2  # of a spot's energy relative to its deviation from the mean, in the interpolation


def spot_energies(samples: Samples, laser: int) -> F64:
    """(S,) share of a spot's transmitted power that leaves again; NaN for spots not used.

    What the cameras did not see of a spot is added in the proportion of the radial profile.
    """
    measured, profile = over_directions(samples, laser)
    kernel = samples.spot_pairs.mean(profile)
    area = RayMesh.of(samples.mesh).vertex_areas
    expected = (np.where(measured.observed, kernel, 0.0) * area).sum(axis=1)
    seen = (measured.value * area).sum(axis=1)
    whole = (kernel * area).sum(axis=1)
    enough = expected > 0.3 * whole
    if not enough.any():  # a capture of few pixels: better than nothing
        enough = expected > 0
    return np.where(enough, seen * whole / np.maximum(expected, 1e-12), np.nan)


@method("lambertian", about="an opaque surface of one albedo a vertex", baseline=True, colour="#9aa0a8")
def fit_lambertian(samples: Samples) -> RelightableModel:
    """The baseline: samples -> model. The albedo is kriged between the spots (Rasmussen & Williams 2006,
    eq. 2.25).
    """
    covariance = harmonics(samples.mesh, MOST_HARMONICS).covariance(RANGE_EDGES * samples.edge)
    to_spots = RayMesh.of(samples.mesh).interpolation(samples.spots.triangle, samples.spots.barycentric)
    albedos = []
    for laser in range(len(samples.values)):
        energy = spot_energies(samples, laser)
        known = np.flatnonzero(np.isfinite(energy))
        mean = float(energy[known].mean())
        cross = to_spots[known] @ covariance
        within = cross @ to_spots[known].T + ALBEDO_NOISE * np.eye(len(known))
        albedo = mean + cross.T @ np.linalg.solve(within, energy[known] - mean)
        albedos.append(np.maximum(albedo, 0.0))
    term = LambertianTerm(np.stack(albedos).astype(np.float32))
    return RelightableModel(samples.mesh, Boundary(samples.eta), (term,))
