"""Cosine in, cosine out is reciprocal in every medium."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy import stats
from significance import assert_z, z_of_replicates
from twins import twin

from disco_twin.light.transport import Transport
from disco_twin.light.truth import REPLICATES, truth_columns
from disco_twin.object.build import Medium, TwinBoundary, TwinObject, hat_basis
from pipeline.geometry.fresnel import mean_transmittance

F64 = NDArray[np.float64]
RUNS = 4  # of truth_columns, each of REPLICATES replicates: 28 degrees of freedom


def two_halves(kind: str) -> tuple[trimesh.Trimesh, TwinObject]:
    """A convex ellipsoid whose two halves differ in albedo and in sigma_t, with veins across."""
    fine = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    scan = trimesh.creation.icosphere(subdivisions=1, radius=1.0)
    for mesh in (fine, scan):
        mesh.vertices *= [3.0, 2.0, 1.6]
    sigma_t = np.full((1, 1, 4, 6), 1.0, np.float32)
    sigma_t[..., 3:] = 2.0
    sigma_t[..., ::2, :] *= 1.5
    albedo = np.full((1, 1, 4, 6), 0.995, np.float32)
    albedo[..., 3:] = 0.85
    low, high = np.asarray(fine.bounds, float)
    eta = 1.0 if kind == "matched" else 1.4
    boundary = TwinBoundary(kind, eta, 0.3 if kind == "rough" else 0.0)  # type: ignore[arg-type]
    return scan, TwinObject(fine, boundary, Medium(sigma_t, albedo, low, high, (0.6,)))


@pytest.mark.parametrize("kind", ["rough", "matched", pytest.param("smooth", marks=pytest.mark.slow)])
def test_truth_is_symmetric(kind: str) -> None:
    """Rationale: R_d(x_i, x_o) = R_d(x_o, x_i) in any medium; entering, walking and leaving must be each other's
    reverse, and so must the hats of lit and seen vertices.

    Expected behaviour: of all pairs of 42 vertices, no z-score of R[u, v] - R[v, u] exceeds what that many comparisons
    allow, their squares follow chi-squared, and the power that flows from the bright half to the dark one equals that
    which flows back, to better than a percent. A lit dark half and a lit bright half do differ in what they give back.
    """
    scan, obj = two_halves(kind)
    transport = Transport(obj, cells=64)
    basis = hat_basis(obj.mesh, scan)
    columns = np.arange(len(scan.vertices))
    runs = [truth_columns(transport, basis, columns, 10_000, seed) for seed in range(RUNS)]
    area = runs[0].area
    mean = np.mean([run.mean[0] for run in runs], axis=0)
    variance = np.sum([run.standard_error[0] ** 2 for run in runs], axis=0) / RUNS**2
    u, v = np.triu_indices(len(columns), 1)
    seen = np.minimum(mean[u, v], mean[v, u]) > 0.003 * mean.max()  # below, a handful of photons decide
    u, v = u[seen], v[seen]
    t = (mean[u, v] - mean[v, u]) / np.sqrt(variance[u, v] + variance[v, u])
    z = np.sign(t) * stats.norm.isf(stats.t.sf(np.abs(t), RUNS * (REPLICATES - 1)))
    assert len(z) > 300
    assert_z(z, f"pairs, {kind}")
    assert_z((np.sum(z**2) - len(z)) / np.sqrt(2 * len(z)), f"sum of squares, {kind}")
    bright, dark = np.flatnonzero(scan.vertices[:, 0] < -0.1), np.flatnonzero(scan.vertices[:, 0] > 0.1)
    flow = area[:, None] * mean * area
    there, back = flow[np.ix_(bright, dark)].sum(), flow[np.ix_(dark, bright)].sum()
    weight = (area[:, None] * area) ** 2 * variance
    error = np.sqrt(weight[np.ix_(bright, dark)].sum() + weight[np.ix_(dark, bright)].sum())
    assert error < 0.01 * there
    assert_z((there - back) / error, f"flow between the halves, {kind}")
    given = (mean * area).sum(axis=1)
    assert given[bright].mean() > 1.2 * given[dark].mean()


@pytest.mark.parametrize(("kind", "eta"), [("matched", 1.0), ("smooth", 1.3), ("smooth", 1.5)])
def test_a_white_object_gives_back_all_that_enters(kind: str, eta: float) -> None:
    """Rationale: on a convex object without absorption all light that enters leaves again. Of a watt that arrives over
    a hat from all directions Tbar enters, in closed form (Walsh 1926): so much is the integral of the truth's column
    over the surface, whatever the medium and wherever the light enters.
    """
    scan = trimesh.creation.icosphere(subdivisions=1, radius=3.0)
    fine = trimesh.creation.icosphere(subdivisions=3, radius=3.0)
    transport = Transport(twin(fine, kind, eta, 1.5, [1.0]), cells=64)  # type: ignore[arg-type]
    basis, columns = hat_basis(fine, scan), np.array([0, 7, 20])
    runs = [truth_columns(transport, basis, columns, 50_000, seed) for seed in (3, 4)]
    total = np.concatenate([run.replicates[:, 0] @ run.area for run in runs])
    # No photon is absorbed: what varies is how many of a split photon's copies leave inside a replicate.
    assert (total.std(axis=0, ddof=1) < 0.01 * total.mean(axis=0)).all()
    assert_z(z_of_replicates(total, mean_transmittance(eta)), f"all that enters, {kind}, {eta}")
