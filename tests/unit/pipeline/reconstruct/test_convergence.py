"""How fast errors fall with spots and with vertices, against what theory says of each: no renderer, closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from reconstruct_synthetic import F64, make, rmse_log10

from pipeline.geometry.fresnel import Boundary, transmittance
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.reconstruct.global_term.completion import complete
from pipeline.reconstruct.samples.distances import vertex_pairs
from pipeline.relight.lights import Directional

RADIUS = 10.0


def rate(count: F64, error: F64) -> F64:
    """Least-squares slope of log error over log count; error: (..., n)."""
    x = np.log(count) - np.log(count).mean()
    return np.asarray(np.log(error) @ x / (x @ x))


@pytest.mark.slow
def test_the_fill_s_error_falls_with_the_spots() -> None:
    """Rationale: what the profile leaves is a Gaussian field of smoothness 1 to the method (`Harmonics.roughness`).
    Of such a field, seen with noise at n places of a surface, a mean square of n^(-1/2) stays open at best, of a smooth
    one less (van der Vaart and van Zanten 2011: n^(-nu / (nu + 1)) in two dimensions).

    Expected behaviour: over a sixteenfold number of spots, the error of all entries falls at least as n^(-1/4), in
    every draw; the object is smooth, so that it falls faster.
    """
    spots = np.array([20, 320])
    error = np.empty((2, 2))
    for seed, draw in enumerate(error):
        for k, count in enumerate(spots):
            made = make(spots=int(count), noise=0.03, seed=seed)
            draw[k] = rmse_log10(complete(made.samples).terms[0].reflectance[0], made.truth[0])
    assert (rate(spots, error) < -0.25).all()


def radiosity(cosine: F64) -> F64:
    """Exact, of a lit ball, by the cosine between place and light: integral of R_d F_t cos over its lit half."""
    x, w = np.polynomial.legendre.leggauss(120)
    c, phi = (x + 1) / 2, (np.arange(400) + 0.5) / 400 * 2 * np.pi
    entering = w / 2 * transmittance(c, 1.3) * c * RADIUS**2 * 2 * np.pi / len(phi)
    out = np.empty(len(cosine))
    for k, m in enumerate(cosine):
        between = m * c[:, None] + np.sqrt(max(1 - m * m, 0.0)) * np.sqrt(1 - c**2)[:, None] * np.cos(phi)
        distance = RADIUS * np.sqrt(np.maximum(2 - 2 * between, 0.0))
        out[k] = (entering[:, None] * smooth(distance)).sum()
    return out


def smooth(distance: F64) -> F64:
    """R_d that hats resolve, mm^-2."""
    return np.asarray(np.exp(-distance / 5.0) / 100)


def test_a_relit_ball_s_error_falls_with_the_vertices() -> None:
    """Rationale: a perfect model on ever finer meshes under directional light: flux on hats, means of R_d over hats at
    both ends, light linear between vertices. All of these are right to the second order of the edge.

    Expected behaviour: the error at vertices and in the middle of triangles goes as 1 / vertices. Near pairs of hats
    are averaged exactly and far ones by their second moments; their second orders differ by up to 1.6, which may turn
    the slope by .17 over a fifteenfold number of vertices.
    """
    count, error = [], []
    for subdivisions in (1, 2, 3):
        mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
        means = vertex_pairs(mesh).mean(smooth)
        means = 0.5 * (means + means.T)
        term = GlobalTerm(means[None].astype(np.float32), np.ones(means.shape, bool))
        of = RelightableModel(mesh, Boundary(1.3), (term,))
        found = of.lit_by(Directional(direction=(0, 0, -1))).flux[0] @ means
        centre = np.asarray(mesh.triangles_center)
        at = np.concatenate([np.asarray(mesh.vertices)[:, 2] / RADIUS, centre[:, 2] / np.linalg.norm(centre, axis=1)])
        own = np.concatenate([found, found[mesh.faces].mean(axis=1)])
        some = np.random.default_rng(0).choice(len(at), min(len(at), 400), replace=False)
        exact = radiosity(at[some])
        count.append(len(found))
        error.append(np.sqrt(((own[some] - exact) ** 2).mean() / (exact**2).mean()))
    assert error[0] > 0.05
    assert abs(rate(np.array(count), np.array(error)) + 1) < 0.17, error
