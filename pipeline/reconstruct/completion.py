"""The default method: every entry of the symmetric V x V matrix from the columns at the spots.

R_d(x_i, x_o) = [mean of f(distance) over the patches] * exp(s(distance) G(x_i, x_o)), where f is the radial profile of
all samples, s the size of what it leaves unexplained, and G a smooth symmetric function on pairs of surface points.
G solves one symmetric positive definite system: the samples at the spots' barycentric points bind columns and, by
reciprocity, rows; smoothness over the surface on both sides fills the rest. Values are compared with their expectation
linearly and weighted by precision (`Measured.residual`), so that a noisy tail neither dominates nor turns negative.
Samples bind the fit, they are not copied into it: at a spot the model differs from the sample by the sample's noise and
an assumed scatter of R_d below the mesh's resolution (`profile.scatter`); see docs/decisions/0013.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from pipeline.reconstruct.exitance import measure_boundary
from pipeline.reconstruct.harmonics import Harmonics, harmonics
from pipeline.reconstruct.model import ReflectanceModel
from pipeline.reconstruct.profile import Measured, fit_profile, scatter
from pipeline.reconstruct.samples import Samples

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

log = logging.getLogger(__name__)

RANGE_EDGES = 1.3  # correlation length of G in edges; fitted on the quick scene against its truth
NEAR, FAR, TURN_MM = 0.08, 0.6, 6.0  # s(distance): relative deviation of R_d from the profile
ROUNDS = 2  # of Gauss-Newton, for each of as many fits of the profile
TOLERANCE = 1e-2  # of conjugate gradients; every solve starts from the one before
MOST_STEPS = 300
MOST_HARMONICS = 500


def deviation(distance: F64) -> F64:
    """s: standard deviation of log R_d about the radial profile, by distance in mm."""
    return np.asarray(NEAR + (FAR - NEAR) * -np.expm1(-((distance / TURN_MM) ** 2)))


@dataclass(frozen=True)
class SymmetricField:
    """G = U Y U^T on vertices, B G on the spots; Y is symmetric. The prior is Gaussian with mean variance 1.

    vertices: (V, n) U; spots: (S, n) B U; penalty: (n, n) precision of the entries of Y
    """

    vertices: F32
    spots: F32
    penalty: F32

    @classmethod
    def of(cls, basis: Harmonics, to_spots: sparse.csr_array, range_mm: float) -> SymmetricField:
        """Matern on both sides: separable, so that G is smooth along rows and columns alike."""
        rough = basis.roughness(range_mm)
        penalty = rough[:, None] * rough[None, :]
        penalty *= (1.0 / penalty).sum()
        functions = basis.functions.astype(np.float32)
        return cls(functions, np.asarray(to_spots @ functions, np.float32), penalty.astype(np.float32))

    def at_spots(self, y: F32) -> F32:
        """(S, V) values of the field between spots and vertices."""
        return np.asarray((self.spots @ y) @ self.vertices.T)

    def gather(self, entries: F32) -> F32:
        """Adjoint of `at_spots`, symmetrised."""
        y = self.spots.T @ (entries @ self.vertices)
        return np.asarray((y + y.T) / 2)

    def solve(self, target: F64, weight: F64, scale: F64, start: F32) -> F32:
        """Y that minimises sum weight (target - scale * field)^2 + Y penalty Y, by preconditioned conjugate gradients.

        target, weight, scale: (S, V); weight is 0 where nothing was observed. start: (n, n) first guess.
        """
        w = (weight * scale**2).astype(np.float32)
        right = self.gather((weight * scale * target).astype(np.float32))
        precondition = 1.0 / (self.penalty + 0.5 * w.sum())
        y = start
        residual = right - self.gather(w * self.at_spots(y)) - self.penalty * y
        z = residual * precondition
        direction, size = z, float((residual * z).sum())
        stop = TOLERANCE**2 * float((right * right * precondition).sum())
        for _ in range(MOST_STEPS):
            if size <= stop:
                return y
            image = self.gather(w * self.at_spots(direction)) + self.penalty * direction
            length = size / float((direction * image).sum())
            y = y + length * direction
            residual = residual - length * image
            z = residual * precondition
            before, size = size, float((residual * z).sum())
            direction = z + size / before * direction
        log.warning("completion: conjugate gradients stopped after %d steps", MOST_STEPS)
        return y


def measured_of(samples: Samples, laser: int) -> Measured:
    """One laser's samples for the fits; 0 where unobserved."""
    observed = np.isfinite(samples.values[laser])
    value, dark, noise = (
        np.where(observed, a[laser], 0.0).astype(np.float64)
        for a in (samples.values, samples.dark_variance, samples.noise_per_signal)
    )
    return Measured(value, observed, dark, noise)


def complete_laser(samples: Samples, laser: int, field: SymmetricField, start: F32) -> tuple[F64, F64, F32]:
    """One laser: (V, V) completed R_d, symmetric and positive, (S, V) R_d at the spots, both in mm^-2, and Y.

    start: (n, n) first guess of Y, the laser's before.
    """
    pairs, vertex_pairs = samples.spot_pairs, samples.vertex_pairs
    measured = measured_of(samples, laser)
    edge = float(samples.mesh.edges_unique_length.mean())
    scale, y = deviation(pairs.distance), start
    fit = field.at_spots(y).astype(np.float64)
    profile = None
    for _ in range(ROUNDS):
        profile = fit_profile(pairs, measured, edge, scale * fit, start=profile)
        prior = pairs.mean(profile)
        for _ in range(ROUNDS):
            relative, weight = measured.residual(prior * np.exp(scale * fit), pairs.distance)
            y = field.solve(relative + scale * fit, weight, scale, y)
            fit = field.at_spots(y).astype(np.float64)
    kernel = vertex_pairs.mean(fit_profile(pairs, measured, edge, scale * fit, samples.tilt, profile))
    exponent = deviation(vertex_pairs.distance) * (field.vertices @ y @ field.vertices.T)
    complete = 0.5 * (kernel + kernel.T) * np.exp(0.5 * (exponent + exponent.T))
    return complete, prior * np.exp(scale * fit), y


def unexplained(samples: Samples, basis: Harmonics, range_mm: float) -> F64:
    """(V, V) share of the prior variance of G that the samples leave, 0..1, by kriging from either side.

    From the side of u: the share that spots leave at u, where those spots saw v; the better of both sides counts.
    """
    covariance = basis.covariance(range_mm)
    used = samples.spots.transmitted > 0
    to_spots = samples.lit[np.flatnonzero(used)]
    cross = to_spots @ covariance  # (S, V)
    noise = (scatter(np.zeros(1)) / NEAR) ** 2
    gain = np.linalg.solve(cross @ to_spots.T + noise * np.eye(len(cross)), cross)
    explained = (cross * gain).sum(axis=0) / np.diag(covariance)
    share = np.abs(gain) / np.maximum(np.abs(gain).sum(axis=0), 1e-12)
    seen = share.T @ np.isfinite(samples.values[0, used]).astype(np.float64)
    left = 1.0 - explained[:, None] * seen
    return np.asarray(np.clip(np.minimum(left, left.T), 0.0, 1.0))


def measured_entries(samples: Samples) -> NDArray[np.bool_]:
    """(V, V) entries next to a sample: a spot lies in a triangle at one vertex and the other vertex was observed."""
    out = np.zeros((len(samples.mesh.vertices),) * 2, bool)
    for spot in np.flatnonzero(samples.spots.transmitted > 0):
        out[samples.mesh.faces[samples.spots.triangle[spot]]] |= np.isfinite(samples.values[:, spot]).all(axis=0)
    return out | out.T


def complete(samples: Samples) -> ReflectanceModel:
    """The default method: samples -> model."""
    range_mm = RANGE_EDGES * float(samples.mesh.edges_unique_length.mean())
    basis = harmonics(samples.mesh, MOST_HARMONICS)
    field = SymmetricField.of(basis, samples.lit, range_mm)
    y, found, at_spots = np.zeros_like(field.penalty), [], []
    for laser in range(len(samples.values)):
        entries, at_spot, y = complete_laser(samples, laser, field, y)
        found.append(entries)
        at_spots.append(at_spot)
    reflectance = np.stack(found)
    distance = samples.vertex_pairs.distance
    relative = deviation(distance) ** 2 * unexplained(samples, basis, range_mm) + scatter(distance) ** 2
    return ReflectanceModel(
        samples.mesh,
        reflectance.astype(np.float32),
        (reflectance**2 * relative).astype(np.float32),
        measured_entries(samples),
        measure_boundary(samples.mesh, samples.eta, samples.glow, np.stack(at_spots)),
        {"method": "default"},
    )
