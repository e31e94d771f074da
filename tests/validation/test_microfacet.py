"""The pipeline's lobe of a rough surface against the renderer's own, which the twin's surfaces are made of."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from pipeline.geometry.microfacet import reflected, rough_transmittance


@pytest.mark.parametrize(("eta", "alpha"), [(1.3, 0.1), (1.5, 0.35), (1.8, 0.6)])
def test_the_lobe_is_mitsubas(eta: float, alpha: float) -> None:
    """Rationale: an implementation by others of the same published model. Expected: equal to single precision."""
    bsdf = mi.load_dict(
        {"type": "roughdielectric", "int_ior": eta, "ext_ior": 1.0, "alpha": alpha, "distribution": "ggx"}
    )
    rng = np.random.default_rng(1)
    both = rng.standard_normal((2, 500, 3))
    both[..., 2] = np.abs(both[..., 2]) + 0.05
    both /= np.linalg.norm(both, axis=2, keepdims=True)
    into, out = both
    half = (into + out) / np.linalg.norm(into + out, axis=1, keepdims=True)
    ours = reflected(half[:, 2], (half * into).sum(axis=1), into[:, 2], out[:, 2], eta, alpha) * out[:, 2]
    at = mi.SurfaceInteraction3f()
    at.wi = mi.Vector3f(*into.T.astype(np.float32))
    at.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    theirs = np.array(bsdf.eval(mi.BSDFContext(), at, mi.Vector3f(*out.T.astype(np.float32)))).reshape(-1, 500)[0]
    np.testing.assert_allclose(ours, theirs, rtol=2e-4, atol=1e-6 * theirs.max())


@pytest.mark.parametrize(("eta", "alpha"), [(1.3, 0.1), (1.5, 0.35), (1.7, 0.6)])
@pytest.mark.parametrize("cosine", [0.05, 0.2, 0.5, 1.0])
def test_the_transmittance_is_mitsubas(eta: float, alpha: float, cosine: float) -> None:
    """Rationale: the weights of directions that the renderer samples through its own boundary add up to the quadrature
    of ours. Expected: a z-score of chance, and a five-hundredth for the quadrature's points.
    """
    bsdf = mi.load_dict(
        {"type": "roughdielectric", "int_ior": eta, "ext_ior": 1.0, "alpha": alpha, "distribution": "ggx"}
    )
    n, rng = 400_000, np.random.default_rng(2)
    at = mi.SurfaceInteraction3f()
    at.wi = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0.0, cosine)
    at.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    draws = rng.random((3, n)).astype(np.float32)
    context = mi.BSDFContext(mi.TransportMode.Importance)
    sample, weight = bsdf.sample(context, at, mi.Float(draws[0]), mi.Point2f(*draws[1:]))
    passed = np.where(np.array(sample.wo).reshape(3, -1)[2] < 0, np.array(weight).reshape(-1, n)[0], 0.0)
    ours = float(rough_transmittance(np.array([cosine]), eta, alpha)[0])
    assert abs(passed.mean() - ours) < 4 * passed.std() / n**0.5 + 0.002
