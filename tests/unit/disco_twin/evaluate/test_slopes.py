"""Slopes of the angular term against moments that follow a known law."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from disco_twin.evaluate.slopes import EDGES, half_square_sine, score_slopes, stated_slopes, true_slopes
from disco_twin.light.moments import Moments
from disco_twin.object.build import TwinBoundary
from pipeline.geometry.fresnel import Boundary
from pipeline.model.lambertian import LambertianTerm
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.model.tilt import TiltLaw

F64 = NDArray[np.float64]
MESH = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
POINTS, EDGE = np.asarray(MESH.vertices), float(MESH.edges_unique_length.mean())
MATCHED = TwinBoundary("matched", 1.0, 0.0)
KNOTS = EDGE * np.array(EDGES[:4])
LAW = TiltLaw(KNOTS, np.array([0.5, 0.6, 0.4, 0.2]))
COLUMNS = np.arange(0, len(POINTS), 60)


def made(noise: float = 0.0, seed: int = 0) -> Moments:
    """Moments by the law, with independent noise in every entry of every replicate."""
    rng, normal = np.random.default_rng(seed), POINTS[COLUMNS] / 10.0
    tangent = np.eye(3) - normal[:, :, None] * normal[:, None]
    axes = np.linalg.svd(normal[:, None, :])[2][:, 1:]
    way = POINTS[None] - POINTS[COLUMNS][:, None]
    r = np.linalg.norm(way, axis=2)
    e = way / np.maximum(r, 1e-9)[:, :, None]
    plain = np.exp(-r / 2.0) * rng.lognormal(0, 0.3, r.shape)
    along = plain * 0.25 * LAW(r) * np.einsum("uvx,uxy,uay->auv", e, tangent, axes)
    noisy = [plain * (1 + noise * rng.standard_normal((8, *plain.shape))),
             along + plain * noise * rng.standard_normal((8, *along.shape))]  # fmt: skip
    return Moments(np.asarray(1), COLUMNS, axes, tangent, *(x.astype(np.float32) for x in noisy))


def model(slopes: F64 | None, eta: float = 1.3, variance: float | None = 1e-4) -> RelightableModel:
    r = np.linalg.norm(POINTS[:, None] - POINTS, axis=2)
    reflectance = np.exp(-r / 2.0)[None].repeat(3, axis=0).astype(np.float32)
    own = {} if slopes is None else {"tilt": np.stack([0 * slopes, slopes, 9 + 0 * slopes]), "tilt_distance": KNOTS}
    if slopes is not None and variance is not None:
        own["tilt_variance"] = np.full((3, len(KNOTS)), variance)
    return RelightableModel(MESH, Boundary(eta), (GlobalTerm(reflectance, np.ones(r.shape, bool), None, **own),))


def test_half_the_square_of_the_sine_of_what_passes() -> None:
    """A quarter without a boundary; less light enters obliquely through one."""
    assert half_square_sine(MATCHED) == pytest.approx(0.25, rel=1e-5)
    smooth, rough = (half_square_sine(TwinBoundary(kind, 1.5, 0.3)) for kind in ("smooth", "rough"))
    assert 0.2 < smooth < 0.25 and 0.2 < rough < 0.25


def test_a_known_law_is_found() -> None:
    distance, slopes = true_slopes(made(), POINTS, EDGE, MATCHED)
    np.testing.assert_allclose(distance, KNOTS)
    np.testing.assert_allclose(slopes, np.broadcast_to(LAW.slope, slopes.shape), atol=2e-4)


def test_its_errors_are_honest() -> None:
    """Rationale: forty truths with noise. Expected: no bias, and z-scores of the exact law with the rms 1."""
    z = []
    for seed in range(40):
        _, slopes = true_slopes(made(0.3, seed), POINTS, EDGE, MATCHED)
        _, own = score_slopes((LAW.slope, None), KNOTS, slopes)
        assert own.count == len(KNOTS) and own.rms is not None
        z.append((LAW.slope - slopes.mean(axis=0)) / (slopes.std(axis=0, ddof=1) / np.sqrt(8)))
    mean = np.mean(z, axis=0)
    assert np.abs(mean).max() < 4 * 1.2 / np.sqrt(40)
    assert np.sqrt((np.square(z) * 5 / 7).mean()) == pytest.approx(1.0, abs=0.2)  # Student's t


def test_slopes_are_compared_by_the_sine_outside() -> None:
    """Rationale: a model's index is assumed; what images tell is s / eta."""
    distance, slopes = true_slopes(made(0.1), POINTS, EDGE, MATCHED)
    for eta in (1.3, 1.6):
        stated = stated_slopes(model(LAW.slope * eta, eta), 1, distance)
        assert stated is not None and stated[1] is not None
        np.testing.assert_allclose(stated[0], LAW.slope, rtol=1e-9)
        np.testing.assert_allclose(stated[1], 1e-4 / eta**2)
        rows, z = score_slopes(stated, distance, slopes)
        assert z.rms is not None and z.rms < 2.5
        assert rows["model_sd"] == pytest.approx([0.01 / eta] * len(KNOTS))
    half = stated_slopes(model(0.5 * LAW.slope * 1.3), 1, distance)
    assert half is not None
    rows, z = score_slopes(half, distance, slopes)
    assert z.rms is not None and z.rms > 5
    assert max(rows["z"]) < 0


def test_what_is_left_out_states_none() -> None:
    """A model that leaves directions out says 0, one without R_d says nothing."""
    distance, slopes = true_slopes(made(0.1), POINTS, EDGE, MATCHED)
    stated = stated_slopes(model(None), 1, distance)
    assert stated is not None and stated[1] is None and not stated[0].any()
    rows, z = score_slopes(stated, distance, slopes)
    assert rows["model_sd"] is None and z.rms is not None and z.rms > 5
    opaque = replace(model(None), terms=(LambertianTerm(np.ones((3, len(POINTS)), np.float32)),))
    assert stated_slopes(opaque, 1, distance) is None


def test_a_truth_without_light_has_no_slopes() -> None:
    dark = made()
    dark = replace(dark, plain=0 * dark.plain, along=0 * dark.along)
    distance, slopes = true_slopes(dark, POINTS, EDGE, MATCHED)
    rows, z = score_slopes((np.zeros(0), None), distance, slopes)
    assert rows["z"] == [] and z.count == 0
    rows, z = score_slopes((np.ones(2), None), np.ones(2), np.zeros((8, 2)))  # nothing is known of its errors
    assert rows["z"] == [None, None] and z.count == 0
