"""The angular moments of the truth: exact displacements of a half-space, and how far light is displaced on a ball."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from half_spaces import HFunction
from numpy.typing import NDArray
from scipy import sparse
from significance import assert_z, z_of_replicates
from twins import twin

from disco_twin.evaluate.slopes import half_square_sine, true_slopes
from disco_twin.light.moments import copies_of_one_laser, moments
from disco_twin.light.transport import Transport
from disco_twin.light.truth import hat_areas
from disco_twin.object.build import TwinBoundary

F64 = NDArray[np.float64]
RATE = 10.0  # free paths per mm


def graded_block(half: float = 10.0, steepness: float = 6.0) -> trimesh.Trimesh:
    """A block with a vertex in the middle of its upper face, z = 0, whose triangles are the finer the nearer to it."""
    mesh = trimesh.creation.box(extents=[2.0, 2.0, 2.0])
    for _ in range(3):
        mesh = mesh.subdivide()
    x = np.asarray(mesh.vertices)
    stretched = np.sinh(steepness * x) / np.sinh(steepness) * half
    return trimesh.Trimesh(np.column_stack([stretched[:, :2], 5.0 * (x[:, 2] - 1.0)]), mesh.faces, process=False)


def test_moments_of_a_half_space_are_exact() -> None:
    """Rationale: Lambertian light over one hat of a matched half-space; the mean of (d . a)(x . a) power that leaves is
    sin(theta) times the exact displacement of every angle (`HFunction.displacement`), averaged over the hemisphere. It
    does not matter where on its hat a photon enters, for d does not depend on it; but photons start a little above the
    surface, 1e-4 of the block's size, and enter farther along their way by as much times the tangent.

    Expected behaviour: M adds up to what is given back and T to that mean along both axes, and to nothing across;
    z-scores from 24 replicates.
    """
    albedo = 0.9
    mesh = graded_block()
    column = int(np.argmin(np.linalg.norm(mesh.vertices, axis=1)))
    assert np.linalg.norm(mesh.vertices[column]) < 1e-9
    own = copies_of_one_laser(twin(mesh, "matched", 1.0, RATE, (0.5, albedo)), 1)
    transport, basis = Transport(own, cells=64), sparse.identity(len(mesh.vertices), format="csr")
    runs = [moments(transport, basis, np.array([column]), 1, 120_000, seed) for seed in range(3)]
    plain, along = (np.concatenate([getattr(r, name) for r in runs]) for name in ("plain", "along"))
    area, axes = hat_areas(transport, basis), runs[0].axes[0]
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-9)
    np.testing.assert_allclose(axes[:, 2], 0, atol=1e-9)
    np.testing.assert_allclose(runs[0].tangent[0], np.diag([1.0, 1.0, 0.0]), atol=1e-9)
    h = HFunction.of(albedo)
    arriving, sine = 2 * h.nodes * h.weights, np.sqrt(1 - h.nodes**2)
    leaving = h.given_back(h.nodes)
    assert_z(z_of_replicates(plain[:, 0] @ area, (arriving * leaving).sum()), "light")
    moved = np.einsum("rav,v,vx,bx->rab", along[:, :, 0], area, np.asarray(mesh.vertices), axes) * RATE
    before = RATE * 1e-4 * np.abs(mesh.vertices).max() * sine / h.nodes
    mean = 0.5 * (arriving * leaving * (h.displacement(h.nodes) + before) * sine).sum()
    assert_z(z_of_replicates(moved, mean * np.eye(2)), "moments")


def test_far_light_is_displaced_by_a_third_more_than_a_free_path() -> None:
    """Rationale: far from the entry, light of the cosine mu has the amplitude H(mu), and is displaced by
    sin(theta) l (1 + mu H' / H) (the logarithmic derivative by 1 / mu, as in `HFunction.displacement`; deep first
    collisions reach far). Lambertian light then has the slope -l' d ln R_d / dr by the sine, with
    l' = int 2 mu (1 - mu^2) (mu H)' dmu / 2 over k int 2 mu H dmu: 1.31 transport mean free paths.

    Expected behaviour: so on a ball of 30 free paths from 5 to 20 free paths away, within 8 %: light of an albedo of
    .999 still sees the curvature, and its amplitude is H to a few per cent.
    """
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=6.0)
    transport = Transport(copies_of_one_laser(twin(mesh, "matched", 1.0, 5.0, (0.999,)), 0), cells=64)
    basis, columns, points = sparse.identity(len(mesh.vertices), format="csr"), np.arange(0, 640, 80), mesh.vertices
    found = moments(transport, basis, columns, 0, 40_000, 4)
    r = np.linalg.norm(points[None] - points[columns][:, None], axis=2)
    seen = (r > 0.8) & (r < 5.0)
    fit = np.polynomial.Polynomial.fit(np.log(r[seen]), np.log(found.mean[seen]), 5)
    used = (r > 1.0) & (r < 4.0)
    fall, level = -fit.deriv()(np.log(r[used])) / r[used], np.exp(fit(np.log(r[used])))
    e = (points[None] - points[columns][:, None]) / np.where(r > 0, r, 1.0)[:, :, None]
    ahead = np.einsum("uvx,uxy,uay->auv", e, found.tangent, found.axes)[:, used]
    boundary = TwinBoundary("matched", 1.0, 0.0)
    expected = half_square_sine(boundary) * ahead * fall
    length = (found.along[:, :, used] / level * expected).sum(axis=(1, 2)) / (expected**2).sum()
    h = HFunction.of(1.0)
    amplitude = (1 - h.nodes**2) * (h(h.nodes) + h.nodes * h.derivative(h.nodes))
    exact = (h.nodes * h.weights * amplitude).sum() / (0.5 * h.moment(1)) / 5.0
    assert exact == pytest.approx(1.31 / 5.0, rel=0.01)
    assert length.std(ddof=1) / np.sqrt(len(length)) < 0.02 * exact
    assert length.mean() == pytest.approx(exact, rel=0.08)
    distance, slopes = true_slopes(found, points, 0.7, boundary)  # the same, as it is scored
    at = slopes.mean(axis=0)[2] / -fit.deriv()(np.log(distance[2])) * distance[2]
    assert at == pytest.approx(exact, rel=0.15)
