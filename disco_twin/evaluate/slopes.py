"""The angular term against the truth: by how much more light leaves ahead of where it entered, by distance.

The law (`pipeline.model.tilt`) has R_d times 1 + s(r) t . e, t = d / eta. Of Lambertian light that enters over a hat it
makes the moment T(u, a, v) = M(u, v) k s(r) / eta (e N a), with k the mean of sin^2(theta) / 2 of what enters, N the
mean of 1 - n n^T over the hat, e the unit vector from u to v (`disco_twin.light.moments`). So s / eta, the slope by the
sine outside, follows from T and M by least squares; images tell no more than that either, for the index is assumed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from disco_twin.evaluate.z_scores import ZScores, honest, over
from disco_twin.light.moments import Moments
from disco_twin.light.truth import standard_error
from disco_twin.object.build import TwinBoundary
from hw.base.arrays import F64
from pipeline.geometry.fresnel import transmittance
from pipeline.geometry.microfacet import rough_transmittance
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.model.tilt import TiltLaw

EDGES = (1.0, 2.0, 4.0, 8.0, 16.0)  # of the scan: where slopes are stated, as far as the object reaches
RINGS = 40  # of distance, in which entries of M count alike
NODES = 400


def half_square_sine(boundary: TwinBoundary) -> float:
    """k: mean of sin^2(theta) / 2 over Lambertian light that passes the boundary, theta outside; 1/4 without one."""
    cosine = (np.arange(NODES) + 0.5) / NODES
    if boundary.kind == "rough":
        passed = rough_transmittance(cosine, boundary.eta, boundary.alpha)
    else:
        passed = transmittance(cosine, boundary.eta)
    weight = passed * cosine
    return float(0.5 * (weight * (1 - cosine**2)).sum() / weight.sum())


def true_slopes(moments: Moments, points: F64, edge: float, boundary: TwinBoundary) -> tuple[F64, F64]:
    """(K,) distances in mm, and (R, K) the slopes by the sine there, by replicate. points: (V, 3) the scan's vertices;
    edge: its mean, mm. Entries whose M is known to worse than a half are left out; without any
    there are no distances.
    """
    way = points[None] - points[moments.columns][:, None]
    r = np.linalg.norm(way, axis=2)
    apart, mean = r > 0, moments.mean
    ahead = np.einsum("uvx,uxy,uay->auv", way / np.where(apart, r, 1.0)[:, :, None], moments.tangent, moments.axes)
    used = apart & (mean > 0) & (standard_error(moments.plain) < 0.5 * mean)
    knots = edge * np.array(EDGES)
    knots = knots[knots < r[used].max(initial=0.0)]
    if not len(knots):
        return knots, np.zeros((len(moments.along), 0))
    # Weights by the mean over a ring: an entry's own noise must not decide how much it counts.
    ring = np.digitize(r, np.geomspace(r[apart].min(), r.max(), RINGS))
    total, count = (np.bincount(ring[used], x[used], RINGS + 1) for x in (mean, np.ones_like(mean)))
    scale = np.where(used, count[ring] / np.maximum(total[ring], 1e-300), 0.0)
    expected = scale * mean * half_square_sine(boundary) * ahead
    design = (expected[..., None] * TiltLaw.basis(r, knots)).reshape(-1, len(knots))
    observed = (scale * moments.along).reshape(len(moments.along), -1)
    return knots, np.linalg.solve(design.T @ design, design.T @ observed.T).T


def stated_slopes(model: RelightableModel, laser: int, distance: F64) -> tuple[F64, F64 | None] | None:
    """(K,) a model's slopes by the sine at these distances in mm, and their variance where it states one: 0 where it
    leaves directions out; None where it has no R_d that could have any.
    """
    terms = [term for term in model.terms if isinstance(term, GlobalTerm)]
    if not terms:
        return None
    (term, *_), eta = terms, model.boundary.eta
    if term.tilt is None or term.tilt_distance is None:
        return np.zeros(len(distance)), None
    law = TiltLaw(term.tilt_distance, term.tilt[laser])
    if term.tilt_variance is None:
        return law(distance) / eta, None
    return law(distance) / eta, TiltLaw.basis(distance, law.distance) ** 2 @ term.tilt_variance[laser] / eta**2


def score_slopes(stated: tuple[F64, F64 | None], distance: F64, true: F64) -> tuple[Mapping[str, Any], ZScores]:
    """{distance_mm, truth, truth_se, model, model_sd, z} by distance, and the z-scores together: of the model's slopes
    over what both state, the truth's alone where the model states nothing. true: (R, K) by replicate
    """
    slope, variance = stated
    mean, error = true.mean(axis=0), standard_error(true)
    noise = honest(error**2, len(true) - 1)
    z = over(slope - mean, noise if variance is None else noise + variance)
    rows = {
        "distance_mm": distance.tolist(),
        "truth": mean.tolist(),
        "truth_se": error.tolist(),
        "model": slope.tolist(),
        "model_sd": None if variance is None else np.sqrt(variance).tolist(),
        "z": [float(own) if np.isfinite(own) else None for own in z],
    }
    return rows, ZScores.of(z)
