"""Baseline: the resampling and interpolation of the thesis (5.3.1 and 5.3.2), its slips corrected.

Corrected are: R_d instead of the throughput F = R_d * area is filled and symmetrised, since F is symmetric on equal
areas only; the explicit step is the largest stable one for the shortest edges instead of a constant. The smoothing is
the least-squares one, psi(x) = 2 x / sigma^2; sigma cancels against the step.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from pipeline.calibrate.fresnel import Boundary
from pipeline.reconstruct.completion import measured_entries
from pipeline.reconstruct.model import ReflectanceModel
from pipeline.reconstruct.samples import Samples

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

ITERATIONS = 150
STEP = 0.9  # of the largest stable one


def distribute(samples: Samples, laser: int) -> tuple[F64, Bool]:
    """(V, V) columns of the vertices around spots, and which entries were measured.

    A spot counts for the three vertices of its triangle by its barycentric coordinates; several spots are averaged.
    """
    size = len(samples.mesh.vertices)
    used = np.flatnonzero(samples.spots.transmitted > 0)
    value = samples.values[laser, used].astype(np.float64)
    seen = np.isfinite(value)
    rows = samples.mesh.faces[samples.spots.triangle[used]]
    share = samples.spots.barycentric[used]
    to_vertices = sparse.csr_array(
        (share.ravel(), (rows.ravel(), np.repeat(np.arange(len(used)), 3))), shape=(size, len(used))
    )
    weight = to_vertices @ seen.astype(np.float64)
    total = to_vertices @ np.where(seen, value, 0.0)
    known = weight > 1e-3
    return np.where(known, total / np.maximum(weight, 1e-3), 0.0), known


def neighbours(vertices: F64, edges: NDArray[np.int64]) -> sparse.csr_array:
    """(V, V) matrix of one explicit step alpha * sum over neighbours of (F_n - F_r) / e_nr, scaled to be stable."""
    inverse = 1.0 / np.maximum(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1), 1e-9)
    both = np.concatenate([edges, edges[:, ::-1]])
    size = len(vertices)
    pull = sparse.csr_array((np.concatenate([inverse, inverse]), (both[:, 0], both[:, 1])), shape=(size, size))
    degree = pull.sum(axis=1)
    return sparse.csr_array((STEP / degree.max()) * (pull - sparse.diags_array(degree)))


def fill(values: F64, known: Bool, step: sparse.csr_array) -> F64:
    """Fill unknown entries within columns whose spot was seen, then whole columns from neighbouring ones.

    values, known: (V, V), symmetrised at the beginning, after every iteration and at the end (thesis 5.3.2). Known
    entries stay as they are.
    """
    count = known.astype(np.float64) + known.T
    start = np.where(count > 0, (values + values.T) / np.maximum(count, 1.0), 0.0)
    fixed = count > 0
    lit = np.diag(fixed)
    out, step = start.astype(np.float32), step.astype(np.float32)
    within = ~fixed & (lit[:, None] | lit[None, :])
    for entries in (within, ~fixed):
        open_entries = 0.5 * entries.astype(np.float32)
        for _ in range(ITERATIONS):
            change = step @ out  # out is symmetric: the same along rows is its transpose
            out = out + open_entries * (change + change.T)
    return np.asarray(np.where(fixed, start, out), np.float64)


def resample_2004(samples: Samples) -> ReflectanceModel:
    """The baseline: samples (read by bilinear look-up) -> model. R_d in mm^-2 per laser."""
    step = neighbours(np.asarray(samples.mesh.vertices), np.asarray(samples.mesh.edges_unique))
    filled = [fill(*distribute(samples, laser), step) for laser in range(len(samples.values))]
    reflectance = np.stack(filled).astype(np.float32)
    return ReflectanceModel(
        samples.mesh, reflectance, np.zeros_like(reflectance), measured_entries(samples), Boundary(samples.eta),
        {"method": "disco2004"},
    )  # fmt: skip
