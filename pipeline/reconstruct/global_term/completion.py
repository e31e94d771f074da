"""The default method: every entry of the symmetric V x V matrix from the columns at the spots.

R_d(x_i, x_o) = [mean of f(distance) over the patches] * exp(m(x_i, x_o) + s(distance) G(x_i, x_o)), where f is the
radial profile of all samples, m what a homogeneous medium of the scan's shape adds to it, s the size of what both leave
unexplained, and G a smooth symmetric function on pairs of surface points.
G solves one symmetric positive definite system: the samples at the spots' barycentric points bind columns and, by
reciprocity, rows; smoothness over the surface on both sides fills the rest. Values are compared with their expectation
linearly and weighted by precision (`LaserSamples.residual`), so that a noisy tail neither dominates nor turns negative.

The fit fills what was not measured. An entry next to a spot holds the sample itself, as far as its noise
allows (`hold_measured`): fill overwrites nothing that was measured (docs/decisions/0013).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg
from scipy.special import chdtri  # scipy.stats takes most of a second to import

from hw.base.arrays import F32, F64, Bool
from hw.base.outcome import Outcome, Unsolved
from pipeline.geometry.mesh import RayMesh
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import WITHOUT, RelightableModel
from pipeline.model.tilt import TiltLaw
from pipeline.reconstruct.global_term.boundary_fit import measure_boundary, of_mean_one
from pipeline.reconstruct.global_term.harmonics import Harmonics, harmonics
from pipeline.reconstruct.global_term.prior import FAR, deviation, medium_priors
from pipeline.reconstruct.global_term.radial_profile import TILT_EDGES, ProfileFit, fit_profile, plain_profile
from pipeline.reconstruct.global_term.totals import steady_totals
from pipeline.reconstruct.medium.medium_fit import MediumPrior
from pipeline.reconstruct.samples.laser_samples import LaserSamples
from pipeline.reconstruct.samples.samples import ANGULAR, Samples, SpotSumImage
from pipeline.reconstruct.samples.spots import tilts

log = logging.getLogger(__name__)

RANGE_EDGES = 2.0  # of the scan: correlation length of G, chosen by leaving spots out (docs/decisions/0013)
BOTH_ENDS = 2 * ANGULAR**2  # relative variance of any entry that directions leave, in and out
ROUNDS = 2  # of Gauss-Newton, for each of as many fits of the profile
TOLERANCE = 1e-3  # of conjugate gradients: what is left stays below the stated errors (docs/decisions/0083)
MOST_STEPS = 300
NEARLY = 100 * TOLERANCE  # with which a field still serves
MOST_HARMONICS = 500
TILT_BY_CHANCE = 1e-3  # probability with which samples without a tilt show one


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
        # Y is symmetric: two entries off the diagonal are one unknown, of half the variance.
        penalty *= 0.5 * ((1.0 / penalty).sum() + (1.0 / np.diag(penalty)).sum())
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

        target, weight, scale: (S, V); weight is 0 where nothing was observed. start: (n, n) first guess. Raises:
        Unsolved where after `MOST_STEPS` too much is left.
        """
        w = (weight * scale**2).astype(np.float32)
        # Preconditioned from both sides, so that the residual is judged as the preconditioner weighs it.
        half = 1.0 / np.sqrt(self.penalty + np.float32(0.5) * w.sum())

        def apply(unknown: F32) -> F32:
            y = half * unknown.reshape(half.shape)
            return np.asarray(half * (self.gather(w * self.at_spots(y)) + self.penalty * y)).ravel()

        system = LinearOperator((half.size, half.size), matvec=apply, dtype=np.float32)
        right = half * self.gather((weight * scale * target).astype(np.float32))
        y, steps = cg(system, right.ravel(), (start / half).ravel(), rtol=TOLERANCE, maxiter=MOST_STEPS)
        if steps:
            left = float(np.linalg.norm(apply(y) - right.ravel()) / np.linalg.norm(right))
            if not left < NEARLY:
                raise Unsolved("the completion's smooth field", Outcome.STOPPED, steps)
            log.warning("completion: conjugate gradients stopped after %d steps", steps)
        return np.asarray(half * y.reshape(half.shape))


@dataclass(frozen=True)
class Fit:
    """One laser's smooth model.

    entries: (V, V) R_d, symmetric and positive; at_spots: (S, V) the same between beams and vertices; both in mm^-2,
    means over all directions; tilt: how single directions depart from them; tilt_variance: (K,) of its slopes;
    tilt_chi2: squares of the slopes that are relit, by their covariance; field: (n, n) Y
    """

    entries: F64
    at_spots: F64
    tilt: TiltLaw
    tilt_variance: F64
    tilt_chi2: float
    field: F32


def forward(slopes: F64) -> F64:
    """The slopes that are relit: light goes on the way that it came, so none is below 0. What samples say against that
    is errors of places; the fit has taken them out of the samples, and the images that a boundary is measured on hold
    them as well.
    """
    return np.maximum(slopes, 0.0)


def fit_laser(
    samples: Samples, laser: int, field: SymmetricField, start: F32, far: float, medium: MediumPrior | None = None
) -> Fit:
    """The profile and the field in turn. start: (n, n) first guess of Y, the laser's before; far: how much log R_d
    departs from its prior far from a spot.
    """
    pairs, vertex_pairs, measured = samples.spot_pairs, samples.vertex_pairs, LaserSamples.of(samples, laser)
    edge = samples.edge
    scale, y = deviation(measured.edges, far), start
    known: F64 | float = 0.0 if medium is None else medium.at_spots
    found: ProfileFit | None = None
    smooth = known + scale * field.at_spots(y)
    for _ in range(ROUNDS):
        if np.any(smooth):
            found = fit_profile(pairs, measured, edge, samples.tilt, smooth, found)
        else:
            found = plain_profile(samples, laser)
        prior = pairs.mean(found.profile) * found.tilt.factor(pairs.distance, samples.tilt)
        for _ in range(ROUNDS):
            relative, weight = measured.residual(prior * np.exp(smooth))
            y = field.solve(relative + smooth - known, weight, scale, y)
            smooth = known + scale * field.at_spots(y)
    found = fit_profile(pairs, measured, edge, samples.tilt, smooth, found)
    kernel = vertex_pairs.mean(found.profile)
    exponent = deviation(vertex_pairs.distance / edge, far) * (field.vertices @ y @ field.vertices.T)
    if medium is not None:
        exponent = exponent + medium.departures
    entries = 0.5 * (kernel + kernel.T) * np.exp(0.5 * (exponent + exponent.T))
    kept = forward(found.tilt.slope)
    shown = float(kept @ np.linalg.solve(found.covariance, kept))
    at_spots, variance = pairs.mean(found.profile) * np.exp(smooth), np.diag(found.covariance)
    return Fit(entries, at_spots, found.tilt, variance, shown, y)


def hold_measured(
    samples: Samples, fits: list[Fit], lognormal_mean_factor: F64, prior_variance: F64
) -> tuple[F64, F64, Bool]:
    """(L, V, V) R_d in mm^-2 that holds what was measured, its relative variance, and (V, V) the measured entries.

    lognormal_mean_factor: (V, V) expectation over the fit; prior_variance: (V, V) relative variance of the fill, where
    nothing was measured.

    A sample is the mean over a beam and a hat function in one direction, an entry the mean over two hat functions and
    all directions. The fit links the two: sample / its expectation = entry / its expectation. Spots whose
    triangle the vertex belongs to are averaged by their share and precision, and by reciprocity from both sides. A
    measured entry is the mean of that and of the fill, by their precisions: the sample itself unless noise drowns it.
    """
    barycentric = np.where(samples.spots.transmitted[:, None] > 0, samples.spots.barycentric, 0.0)
    share = RayMesh.of(samples.mesh).interpolation(samples.spots.triangle, barycentric).T.tocsr()
    squared, measured_in_all = share.multiply(share).tocsr(), measured_entries(samples)
    entries, variances = [], []
    for laser, fit in enumerate(fits):
        measured = LaserSamples.of(samples, laser)
        expected = fit.at_spots * fit.tilt.factor(samples.spot_pairs.distance, samples.tilt)
        variance = measured.variance(expected)
        weight = np.where(measured.observed, 1.0 / (variance + ANGULAR**2), 0.0)
        ratio = share @ (weight * np.where(measured.observed, measured.value / expected, 0.0))
        total = share @ weight
        spread = squared @ (weight**2 * variance)
        for sums in (ratio, total, spread):
            sums += np.where(np.eye(len(sums), dtype=bool), 0.0, sums.T)  # on the diagonal both sides are one sample
        ratio = ratio / np.maximum(total, 1e-30)
        noise = np.where(measured_in_all, spread / np.maximum(total, 1e-30) ** 2, np.inf)
        trust = prior_variance / (prior_variance + noise)  # of the sample against the fill
        factor = trust * np.where(trust > 0, ratio, 0.0) + (1 - trust) * lognormal_mean_factor
        entries.append(np.maximum(fit.entries * factor, 0.0))
        variances.append((1 - trust) * prior_variance)  # = 1 / (1 / prior_variance + 1 / noise)
    return np.stack(entries), np.stack(variances), measured_in_all


def unexplained(samples: Samples, basis: Harmonics, range_mm: float) -> F64:
    """(V, V) share of the prior variance of G that the samples leave, 0..1, by kriging from either side (Rasmussen &
    Williams 2006, eq. 2.26).

    From the side of u: the share that spots leave at u, where those spots saw v; the better of both sides counts.
    """
    covariance = basis.covariance(range_mm)
    used = samples.spots.transmitted > 0
    to_spots = samples.lit[np.flatnonzero(used)]
    cross = to_spots @ covariance  # (S, V)
    noise = (ANGULAR / FAR) ** 2  # far from the spots; near them next to nothing is left open in any case
    gain = np.linalg.solve(cross @ to_spots.T + noise * np.eye(len(cross)), cross)
    explained = (cross * gain).sum(axis=0) / np.diag(covariance)
    share = np.abs(gain) / np.maximum(np.abs(gain).sum(axis=0), 1e-12)
    seen = share.T @ np.isfinite(samples.values[:, used]).all(axis=0).astype(np.float64)
    open_share = 1.0 - explained[:, None] * seen
    return np.asarray(np.clip(np.minimum(open_share, open_share.T), 0.0, 1.0))


def measured_entries(samples: Samples) -> Bool:
    """(V, V) entries next to a sample: a spot lies in a triangle at one vertex and the other vertex was observed."""
    out = np.zeros((len(samples.mesh.vertices),) * 2, bool)
    for spot in np.flatnonzero(samples.spots.transmitted > 0):
        out[samples.mesh.faces[samples.spots.triangle[spot]]] |= np.isfinite(samples.values[:, spot]).all(axis=0)
    return out | out.T


def complete(samples: Samples) -> RelightableModel:
    """Samples -> model of the global term alone, with the boundary that the images show."""
    edge = samples.edge
    basis = harmonics(samples.mesh, MOST_HARMONICS)
    field = SymmetricField.of(basis, samples.lit, RANGE_EDGES * edge)
    media, far, no_medium = medium_priors(samples)
    fits: list[Fit] = []
    for laser in range(len(samples.values)):
        start = fits[-1].field if fits else np.zeros_like(field.penalty)
        fits.append(fit_laser(samples, laser, field, start, far, media[laser] if media else None))
    edges = samples.vertex_pairs.distance / edge
    prior_variance = deviation(edges, far) ** 2 * unexplained(samples, basis, RANGE_EDGES * edge)
    # What is left open about log R_d raises the expectation of R_d: the mean of a log-normal.
    reflectance, relative, measured = hold_measured(
        samples, fits, np.exp(0.5 * prior_variance), prior_variance + BOTH_ENDS
    )

    def expected(view: SpotSumImage) -> F64:
        leaving, entering = tilts(samples.mesh, samples.spots, view.camera.position, samples.eta)
        tilt = leaving + entering
        distance = samples.spot_pairs.distance
        reflected = np.zeros_like(distance)  # the images still hold it
        if samples.lobe is not None and not samples.lobe.because:
            reflected = samples.lobe.in_view(samples.beams, view.camera)
        return np.stack([fit.at_spots * fit.tilt.factor(distance, tilt) + reflected for fit in fits])

    measured_ratio = measure_boundary(samples.mesh, samples.eta, samples.glow, expected)
    boundary = of_mean_one(measured_ratio, samples, np.stack([fit.at_spots for fit in fits]))
    leaves = RayMesh.of(samples.mesh).open_areas(boundary.mean_transmittance)
    level = boundary.mean_transmittance**2
    expected_totals = np.stack([medium.totals for medium in media]) if media else None
    reflectance = steady_totals(reflectance, relative, leaves, level, basis, edge, expected_totals)
    variance = (reflectance**2 * (relative + BOTH_ENDS)).astype(np.float32)
    limit = float(chdtri(len(TILT_EDGES), TILT_BY_CHANCE))
    tilted = max(fit.tilt_chi2 for fit in fits) > limit
    term = GlobalTerm(
        reflectance.astype(np.float32),
        measured,
        variance,
        np.stack([forward(fit.tilt.slope) for fit in fits]) if tilted else None,
        fits[0].tilt.distance if tilted else None,
        np.stack([fit.tilt_variance for fit in fits]) if tilted else None,
    )
    provenance = {}
    if samples.lobe is not None and not samples.lobe.because:
        provenance["taken off"] = f"the surface's reflection, {samples.lobe.described(samples.eta)}"
    if no_medium:
        provenance[f"{WITHOUT}medium"] = no_medium
    if not tilted:
        why = f"samples show no change with direction beyond their noise (chi^2 at most {limit:.0f})"
        provenance[f"{WITHOUT}angular moments"] = why
    return RelightableModel(samples.mesh, boundary, (term,), provenance)
