"""The scan fitted to the silhouettes of all views: its surface and the views' poses in one least squares.

An edge of a silhouette measures by how much the surface lies beside the scan, along its normal, where the line of
sight touches it; how cameras and object stand moves edges as well. The displacement is a Gaussian process over the
scan, alike over one of `LENGTHS_MM` (Rasmussen and Williams 2006, section 2.7: poses are its explicit basis functions).
Its size and length, and the edges' own error, are the likeliest (eq. 5.8). What poses and surface explain alike is
shared out by what is known of both, so that the object's frame stays the scan's. Where no outline passes, displacement
and error return to 0 and to the scanner's.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.optimize import minimize

from hw.base.arrays import F64
from hw.base.outcome import Ended, Outcome
from pipeline.calibrate.edges import Edges
from pipeline.calibrate.least_squares import Huber, Linearised, Prior
from pipeline.calibrate.scan_error import LENGTHS_MM
from pipeline.calibrate.sweep import Sweep, place_prior, pose_jacobian
from pipeline.geometry.mesh import RayMesh, displaced

log = logging.getLogger(__name__)

START = 0.1, 0.1  # mm of the scan, pixels of an edge: where the search for the likeliest begins
STEPS, REWEIGHTED = 3, 2  # edges are found anew after each; weights follow from what is left
OUTLIER = 3.0  # in units of the edges' own error
LEFT, MOST = 1e-3, 1000  # share of the displacement's variance that its expansion leaves out; terms of it
FLAT = 1e-6  # of a motion's size: one that leaves a surface where it is, such as a ball's turn
EVIDENCE = 4.5  # gain of log likelihood below which silhouettes and scan agree: three standard deviations of one size


@dataclass(frozen=True)
class ScanFit:
    """By how much the scan is moved along its vertex normals, outward.

    displacement, error: (V,) mm, with its standard deviation; size_mm: of the scanner's own error, alike_mm: over which
    length it is alike; edge_px: of the edges' own error; chi2_before, chi2_after: mean square of what is left at the
    edges, poses fitted in both, over that error; because: why the scan is left as it is; empty where it is fitted
    """

    displacement: F64
    error: F64
    size_mm: float = 0.0
    alike_mm: float = 0.0
    edge_px: float = 0.0
    chi2_before: float = 0.0
    chi2_after: float = 0.0
    because: str = ""

    def moved(self, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        """The mesh with its vertices where they belong, numbered as before; itself where it is left as it is."""
        return mesh if self.because else displaced(mesh, self.displacement)


def alike(points: F64, length_mm: float) -> F64:
    """(V, m) factor A of exp(-(d / length)^2) = A A^T between (V, 3) points, but for `LEFT`.

    By pivoted Cholesky (Harbrecht, Peters and Schneider 2012, algorithm 1).
    """
    left, columns = np.ones(len(points)), np.zeros((len(points), min(MOST, len(points))))
    for m in range(columns.shape[1]):
        k = int(left.argmax())
        if left[k] < LEFT:
            return columns[:, :m]
        row = np.exp(-((points - points[k]) ** 2).sum(axis=1) / length_mm**2) - columns[:, :m] @ columns[k, :m]
        columns[:, m] = row / np.sqrt(left[k])
        left = np.maximum(left - columns[:, m] ** 2, 0.0)
        left[k] = 0.0
    return columns


@dataclass(frozen=True)
class Expansion:
    """Displacements (`shape` + `motions` @ `whole`) z of standard deviation 1, for independent z of deviation 1.

    Silhouettes do not tell how a scan is moved, turned and scaled as a whole: poses follow. So the shape alone is
    fitted. What they seem to say of the rest comes from how the two go together in the assumed kernel, and so from the
    edges' faintest errors.

    shape: (V, m), without a part that moves the scan as a whole; motions: (V, 7) along the normals by a shift in mm, a
    turn about the scan's middle and a relative size; whole: (7, m)
    """

    shape: F64
    motions: F64
    whole: F64

    @classmethod
    def of(cls, mesh: trimesh.Trimesh, length_mm: float) -> Expansion:
        """Alike over a length; parts are told apart by least squares over the surface."""
        points, normals = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.vertex_normals)
        arms, root = points - points.mean(axis=0), np.sqrt(RayMesh.of(mesh).vertex_areas)[:, None]
        motions = np.column_stack([normals, np.cross(arms, normals), (arms * normals).sum(axis=1)])
        basis = alike(points, length_mm)
        whole = np.linalg.lstsq(motions * root, basis * root, rcond=FLAT)[0]
        return cls(basis - motions @ whole, motions, whole)


@dataclass(frozen=True)
class Joint:
    """A scan fitted together with the poses. sweep: with the poses; fit: its unknowns are the increments, then the
    coefficients of `surface`; edges: K means over pieces of the outline; residual of `fit`: what is left there
    """

    sweep: Sweep
    fit: Linearised
    surface: Expansion
    edges: Edges
    scan: ScanFit

    def with_error(self, covariance: F64) -> ScanFit:
        """The scan with its error, given the (P + m, P + m) covariance of the fit's unknowns."""
        shape, whole = self.surface.shape, self.surface.motions @ self.surface.whole
        own = covariance[-shape.shape[1] :, -shape.shape[1] :]
        variance = ((shape @ own) * shape).sum(axis=1) + self.scan.size_mm**2 * (whole**2).sum(axis=1)
        return replace(self.scan, error=np.sqrt(np.maximum(variance, 0.0)))

    def frame(self, middle: F64) -> F64:
        """(P, P) covariance of the increments because the scan is off as a whole; middle: (3,) of its vertices."""
        moves, changes = [], []
        for v in range(len(self.sweep.lenses) * len(self.sweep.angles)):
            pose = self.sweep.view(v).pose
            turn, none = pose[:3, :3], np.zeros((3, 1))
            moves.append(pose_jacobian(self.sweep, v))
            about = turn @ np.cross(np.eye(3), middle).T  # columns: an axis times the middle
            away = (turn @ middle + pose[:3, 3])[:, None]
            changes.append(np.block([[np.zeros((3, 3)), -turn, none], [-turn, about, away]]))
        follow = np.linalg.lstsq(np.concatenate(moves), np.concatenate(changes), rcond=None)[0] @ self.surface.whole
        return np.asarray(self.scan.size_mm**2 * follow @ follow.T)


@dataclass(frozen=True)
class Evidence:
    """How likely edges are for a displacement's size and the edges' own error, with poses and surface unknown.

    length_mm: of an expansion; jacobian: (K, P + m) of edges by increments and its coefficients; measured: (K,) pixels
    beside the unmoved scan; weight: (K,); prior: of the increments that are still to come
    """

    length_mm: float
    jacobian: F64
    measured: F64
    weight: F64
    prior: Prior

    @cached_property
    def products(self) -> tuple[F64, F64, float]:
        """(P + m, P + m), (P + m,), number: weighted products of derivatives and measurements."""
        weighted = self.jacobian * self.weight[:, None]
        return weighted.T @ self.jacobian, weighted.T @ self.measured, float(self.measured**2 @ self.weight)

    def log_likelihood(self, size_mm: float, edge_px: float) -> float:
        """But for a constant; size 0: no displacement."""
        gram, moment, square = self.products
        places, variance = len(self.prior.mean), edge_px**2
        whole = len(moment) if size_mm > 0 else places
        precision = self.joint_prior(size_mm).precision[:whole, :whole]
        right = moment[:whole] / variance
        right[:places] += self.prior.precision @ self.prior.mean
        factor = cho_factor(gram[:whole, :whole] / variance + precision, lower=True)
        left = square / variance - float(right @ cho_solve(factor, right))
        left += float(self.prior.mean @ self.prior.precision @ self.prior.mean)
        determinant = 2 * float(np.log(np.diag(factor[0])).sum()) - float(np.log(np.diag(precision)).sum())
        return -0.5 * float(left + determinant + len(self.measured) * np.log(variance))

    def joint_prior(self, size_mm: float) -> Prior:
        """Of increments and coefficients."""
        terms = self.jacobian.shape[1] - len(self.prior.mean)
        precision = block_diag(self.prior.precision, np.eye(terms) / max(size_mm, 1e-9) ** 2)
        return Prior(np.concatenate([self.prior.mean, np.zeros(terms)]), precision)

    def likeliest(self, size_mm: float, edge_px: float) -> tuple[float, float, float]:
        """(size in mm, edges' own error in pixels, log likelihood), from a start; a size of 0 stays so."""
        surface = size_mm > 0

        def values(logarithms: Any) -> tuple[float, float]:
            return (float(np.exp(logarithms[0])) if surface else 0.0), float(np.exp(logarithms[-1]))

        def cost(logarithms: Any) -> float:
            return -self.log_likelihood(*values(logarithms))

        options: Any = {"xatol": 0.02, "fatol": 0.02, "maxiter": 80}
        start: Any = np.log([size_mm, edge_px] if surface else [edge_px])
        found = minimize(cost, start, method="Nelder-Mead", options=options)
        Ended(Outcome.CONVERGED if found.success else Outcome.STOPPED, int(found.nit)).warn(
            log, "the scan's likelihood"
        )
        return (*values(found.x), -float(found.fun))

    def fit(self, size_mm: float, edge_px: float) -> Linearised:
        """Of increments and coefficients, before the step."""
        prior = self.joint_prior(size_mm)
        return Linearised(np.zeros_like(prior.mean), -self.measured, self.jacobian, self.weight / edge_px**2, prior)


def fit_scan(sweep: Sweep, images: Sequence[NDArray[np.floating]], mesh: trimesh.Trimesh) -> Joint:
    """From poses fitted without the surface; images: (H, W) of every view.

    Raises: DiscoError where no edge lies near the scan's outline.
    """
    normals, places = np.asarray(mesh.vertex_normals), sweep.size
    expansions = {length: Expansion.of(mesh, length) for length in LENGTHS_MM}
    displacement, size, own = np.zeros(len(normals)), *START
    for _ in range(STEPS):
        every = Edges.of(sweep, images, displaced(mesh, displacement), normals, True)
        edges = every.by_piece(every.length)
        measured, still = edges.away + edges.hats @ displacement, place_prior(sweep)
        weight = np.ones(len(measured))
        for _ in range(REWEIGHTED):
            tried = []
            for length, expansion in expansions.items():
                jacobian = np.column_stack([edges.jacobian, edges.hats @ expansion.shape])
                evidence = Evidence(length, jacobian, measured, weight, still)
                tried.append((evidence, *evidence.likeliest(size, own)))
            best, size, own, likelihood = max(tried, key=lambda one: one[3])
            fit = best.fit(size, own)
            step = fit.step()
            rest = measured - best.jacobian @ step
            used, weight = weight, Huber(OUTLIER * own).weight(rest)
        surface = expansions[best.length_mm]
        expansions = {best.length_mm: surface}  # a length that was likeliest once stays so
        sweep, displacement = sweep.moved(step[:places]), surface.shape @ step[places:]
    _, alone, without = best.likeliest(0.0, own)
    left = measured - edges.jacobian @ best.fit(0.0, alone).step()[:places]
    before, after = (float((used * r**2).mean()) / own**2 for r in (left, rest))
    because = ""
    if likelihood - without < EVIDENCE:
        displacement = np.zeros(len(normals))
        because = f"the silhouettes agree with the scan within {alone:.2g} pixels, their edges' own error"
    scan = ScanFit(displacement, np.full(len(normals), size), size, best.length_mm, own, before, after, because)
    return Joint(sweep, replace(fit, residual=-rest), surface, edges, scan)
