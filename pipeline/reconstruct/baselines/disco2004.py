"""Baseline: the resampling and interpolation of the thesis (5.3.1 and 5.3.2), its slips corrected.

Corrected are: R_d instead of the throughput F = R_d * area is filled and symmetrised, since F is symmetric on equal
areas only; and the explicit iteration, which takes thousands of steps, is replaced by the solution that it tends to.
With the least-squares weighting psi(x) = 2 x / sigma^2 that is one symmetric positive definite system, in which sigma
and alpha have no part. The weighting sign(x) was measured and is worse (docs/decisions/0014).
"""

from __future__ import annotations

import logging

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

from hw.base.arrays import F32, F64, I64, Bool
from hw.base.outcome import Ended, Outcome
from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.mesh import RayMesh
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.reconstruct.global_term.completion import measured_entries
from pipeline.reconstruct.registry import method
from pipeline.reconstruct.samples.samples import Samples

log = logging.getLogger(__name__)

TOLERANCE = 1e-3  # of conjugate gradients
MOST_STEPS = 500


def distribute(samples: Samples, laser: int) -> tuple[F64, Bool]:
    """(V, V) columns of the vertices around spots, and which entries were measured.

    A spot counts for the three vertices of its triangle by its barycentric coordinates; several spots are averaged.
    """
    used = np.flatnonzero(samples.spots.transmitted > 0)
    value = samples.values[laser, used].astype(np.float64)
    seen = np.isfinite(value)
    spots = samples.spots
    to_vertices = RayMesh.of(samples.mesh).interpolation(spots.triangle[used], spots.barycentric[used]).T.tocsr()
    weight = to_vertices @ seen.astype(np.float64)
    total = to_vertices @ np.where(seen, value, 0.0)
    known = weight > 1e-3
    return np.where(known, total / np.maximum(weight, 1e-3), 0.0), known


def neighbours(vertices: F64, edges: I64) -> sparse.csr_array:
    """(V, V) graph Laplacian with weights 1 / e_nr: minus the sum over neighbours of (F_n - F_r) / e_nr."""
    inverse = 1.0 / np.maximum(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1), 1e-9)
    both = np.concatenate([edges, edges[:, ::-1]])
    size = len(vertices)
    pull = sparse.csr_array((np.concatenate([inverse, inverse]), (both[:, 0], both[:, 1])), shape=(size, size))
    return sparse.csr_array(sparse.diags_array(pull.sum(axis=1)) - pull)


def fill(values: F64, known: Bool, laplacian: sparse.csr_array) -> F64:
    """The fixed point of the thesis's iteration: every unknown entry is the weighted mean of its neighbours in its
    column and, the matrix being symmetric, in its row. Known entries stay as they are.

    values, known: (V, V), symmetrised at the beginning (thesis 5.3.2). Preconditioned conjugate gradients.
    """
    count = known.astype(np.float64) + known.T
    fixed = count > 0
    start = np.where(fixed, (values + values.T) / np.maximum(count, 1.0), 0.0)
    operator = laplacian.astype(np.float32)
    degree = np.asarray(operator.diagonal())
    half = (~fixed).astype(np.float32) / np.sqrt(degree[:, None] + degree[None, :])  # 0 where nothing is sought

    def apply(entries: F32) -> F32:
        along = operator @ entries  # entries is symmetric: the same along rows is its transpose
        return np.asarray(half * (along + along.T))

    size = half.size
    system = LinearOperator((size, size), lambda x: apply(half * x.reshape(half.shape)).ravel(), dtype=np.float32)
    filled, steps = cg(system, -apply(start.astype(np.float32)).ravel(), rtol=TOLERANCE, maxiter=MOST_STEPS)
    Ended(Outcome.STOPPED if steps else Outcome.CONVERGED, steps).warn(log, "disco2004's filling")
    return np.asarray(np.where(fixed, start, np.maximum(half * filled.reshape(half.shape), 0.0)), np.float64)


@method("disco2004", about="resampling and filling of the thesis (5.3)", reads="bilinear", colour="#e6a117")
def resample_2004(samples: Samples) -> RelightableModel:
    """The baseline: samples (read by bilinear look-up) -> model. R_d in mm^-2 per laser."""
    laplacian = neighbours(np.asarray(samples.mesh.vertices), np.asarray(samples.mesh.edges_unique))
    filled = [fill(*distribute(samples, laser), laplacian) for laser in range(len(samples.values))]
    term = GlobalTerm(np.stack(filled).astype(np.float32), measured_entries(samples))
    return RelightableModel(samples.mesh, Boundary(samples.eta), (term,))
