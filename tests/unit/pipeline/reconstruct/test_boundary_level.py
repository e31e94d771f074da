"""The level that R_d and the boundary's transmittance share is counted once, wherever it is put."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from reconstruct_capture import ETA, reflectance, rig, write_capture
from reconstruct_synthetic import Synthetic

from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.mesh import RayMesh
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.reconstruct.global_term.boundary_fit import of_mean_one
from pipeline.reconstruct.samples.distances import vertex_pairs
from pipeline.relight.lights import Uniform
from pipeline.run import Request, run

COSINES, RATIO = (0.02, 0.1, 0.2, 0.3, 0.5, 0.95), np.array([2.0, 1.8, 1.4, 1.2, 1.0, 0.95])


@pytest.mark.parametrize("level", [1.0, 0.8])
def test_a_boundary_that_is_not_the_assumed_one_leaves_exitance_right(level: float, tmp_path: Path) -> None:
    """Rationale: images of a sphere from eq. 2.1 with a boundary that transmits more at grazing angles, and one that
    transmits a fifth less everywhere. Images cannot tell R_d's level from the boundary's.

    Expected behaviour: Tbar^2 R_d, and images relit under light from all directions, are those of the same scan with
    the exact R_d and boundary within five per cent, whichever of the two took the level. (The scan is 2 % smaller than
    the sphere.)
    """
    true = Boundary(ETA, COSINES, tuple(level * RATIO))
    write_capture(tmp_path / "capture", boundary=true)
    run(
        tmp_path / "capture",
        tmp_path / "work",
        Request.model_validate({"format_version": 1, "reconstruct": {"methods": ["default"]}}),
    )
    model = RelightableModel.load(tmp_path / "work" / "model-default.npz")
    assert model.boundary.ratio[1] / model.boundary.ratio[-1] > 1.5  # it was seen
    pairs, area = vertex_pairs(model.mesh), RayMesh.of(model.mesh).vertex_areas
    exact = np.stack([pairs.mean(lambda d, k=k: reflectance(d, k)) for k in range(2)])
    exact = (0.5 * (exact + exact.transpose(0, 2, 1))).astype(np.float32)
    perfect = RelightableModel(model.mesh, true, (GlobalTerm(exact, np.ones(exact.shape[1:], bool)),))
    leaving, theirs = (m.leaving(np.arange(len(area)), area).sum(axis=2) for m in (model, perfect))
    np.testing.assert_allclose(leaving.mean(axis=1), theirs.mean(axis=1), rtol=0.05)
    camera = PinholeCamera.from_config(rig().cameras[0])
    # Summed over a sphere's image, light that leaves by F_t is weighted as over the hemisphere.
    light = Uniform(colour=(1.0, 1.0))
    own, their = (m.image(m.lit_by(light), m.seen_by(camera)).sum(axis=(1, 2)) for m in (model, perfect))
    np.testing.assert_allclose(own, their, rtol=0.05)


def test_the_mean_where_samples_are_taken_is_divided_out(small: Synthetic) -> None:
    """Expected behaviour: the plain means over light, in loops; twice the curve is normalised to the same one."""
    rng = np.random.default_rng(3)
    samples = small.samples
    turned = samples.spots.normal + 0.8 * rng.standard_normal(samples.spots.normal.shape)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    cosine = rng.uniform(0.3, 1.0, samples.cosine.shape).astype(np.float32)
    samples = replace(samples, spots=replace(samples.spots, direction=-turned), cosine=cosine)
    boundary = Boundary(ETA, COSINES, tuple(RATIO))
    expected = np.where(np.isfinite(samples.values), samples.values, 1e9).astype(float)  # what nobody saw has no weight
    got = of_mean_one(boundary, samples, expected)
    area, entry, leaving, total = RayMesh.of(samples.mesh).vertex_areas, 0.0, 0.0, 0.0
    for spot in range(len(turned)):
        at_spot = np.interp(samples.spots.normal[spot] @ turned[spot], COSINES, RATIO)
        for vertex in np.flatnonzero(np.isfinite(samples.values[0, spot])):
            light = expected[0, spot, vertex] * area[vertex]
            entry, total = entry + light * at_spot, total + light
            leaving += light * np.interp(cosine[spot, vertex], COSINES, RATIO)
    np.testing.assert_allclose(got.ratio, RATIO / np.sqrt(entry / total * leaving / total), rtol=1e-6)
    doubled = of_mean_one(Boundary(ETA, COSINES, tuple(2 * RATIO)), samples, expected)
    np.testing.assert_allclose(doubled.ratio, got.ratio, rtol=1e-12)
    smooth = of_mean_one(Boundary(ETA), samples, expected)
    assert smooth.ratio == pytest.approx((1.0,))
