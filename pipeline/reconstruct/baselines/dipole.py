"""Baseline: a homogeneous half-space, the dipole of Jensen et al. 2001, fitted to the same samples."""

from __future__ import annotations

import logging

import numpy as np
from scipy.optimize import least_squares

from hw.base.arrays import F64
from hw.base.outcome import Ended, Outcome
from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.mesh import RayMesh
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.reconstruct.global_term.completion import measured_entries
from pipeline.reconstruct.global_term.radial_profile import over_directions
from pipeline.reconstruct.registry import method
from pipeline.reconstruct.samples.distances import Kernel
from pipeline.reconstruct.samples.samples import Samples

log = logging.getLogger(__name__)

BINS = 24
FAINTEST = 1e-3  # bins further below the first are left to noise
ENERGY_WEIGHT = 5.0  # of the total in the fit, relative to one bin


def dipole_reflectance(distance: F64, scattering: float, absorption: float, eta: float) -> F64:
    """R_d(r) in mm^-2 of a half-space (Jensen et al. 2001, eq. 4; thesis 2.3).

    distance: mm; scattering: reduced scattering coefficient sigma_s' in 1/mm; absorption: sigma_a in 1/mm.
    """
    extinction = scattering + absorption
    effective = np.sqrt(3.0 * absorption * extinction)
    inner = -1.440 / eta**2 + 0.710 / eta + 0.668 + 0.0636 * eta  # diffuse Fresnel reflectance from within
    boundary = (1.0 + inner) / (1.0 - inner)
    real, virtual = 1.0 / extinction, (1.0 + 4.0 * boundary / 3.0) / extinction
    out = np.zeros_like(np.asarray(distance, np.float64))
    for depth in (real, virtual):
        d = np.sqrt(np.asarray(distance) ** 2 + depth**2)
        out += depth * (1.0 + effective * d) * np.exp(-effective * d) / d**3
    return np.asarray(scattering / extinction / (4.0 * np.pi) * out)


def _kernel(scattering: float, absorption: float, eta: float) -> Kernel:
    return lambda distance: dipole_reflectance(distance, scattering, absorption, eta)


def fit_dipole_laser(samples: Samples, laser: int) -> tuple[float, float]:
    """(sigma_s', sigma_a) in 1/mm: logarithms of linear means over bins of distance, and of the observed total."""
    pairs, (measured, _) = samples.spot_pairs, over_directions(samples, laser)
    bin_of = np.minimum((pairs.distance / (0.5 * samples.edge)).astype(int), BINS)
    area = np.broadcast_to(RayMesh.of(samples.mesh).vertex_areas, bin_of.shape)

    def totals(values: F64) -> F64:
        """Power per bin over the observed entries."""
        weight = (values * area)[measured.observed]
        return np.bincount(bin_of[measured.observed], weight, minlength=BINS + 1)[:BINS].astype(np.float64)

    seen = totals(measured.value)
    area_seen = totals(np.ones_like(measured.value))
    level = seen / np.maximum(area_seen, 1e-12)
    use = (area_seen > 0) & (level > FAINTEST * level.max())

    def misfit(logs: F64) -> F64:
        model = totals(pairs.mean(_kernel(np.exp(logs[0]), np.exp(logs[1]), samples.eta)))
        energy = np.log(model[use].sum() / seen[use].sum())
        return np.append(np.log(model[use] / seen[use]), ENERGY_WEIGHT * energy)

    fit = least_squares(misfit, np.log([1.0, 0.01]), loss="soft_l1", f_scale=0.3, bounds=(np.log(1e-5), np.log(1e3)))
    Ended(Outcome.CONVERGED if fit.success else Outcome.STOPPED, int(fit.nfev)).warn(log, "the dipole's fit")
    scattering, absorption = np.exp(fit.x)
    return float(scattering), float(absorption)


@method("dipole", about="a homogeneous half-space (Jensen et al. 2001)", baseline=True, colour="#00845f")
def fit_dipole(samples: Samples) -> RelightableModel:
    """The baseline: samples -> model. Its kernel depends on distance alone."""
    found = [fit_dipole_laser(samples, laser) for laser in range(len(samples.values))]
    kernels = [samples.vertex_pairs.mean(_kernel(s, a, samples.eta)) for s, a in found]
    reflectance = np.stack([0.5 * (k + k.T) for k in kernels]).astype(np.float32)
    medium = "; ".join(f"sigma_s' {s:.4g}, sigma_a {a:.4g} per mm" for s, a in found)
    term = GlobalTerm(reflectance, measured_entries(samples))
    return RelightableModel(samples.mesh, Boundary(samples.eta), (term,), {"fit": medium})
