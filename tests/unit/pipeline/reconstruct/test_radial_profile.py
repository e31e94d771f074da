"""R_d against distance alone, and what directions do to it: profile, tilt, and the plainest baselines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reconstruct_synthetic import Synthetic, make, rmse_log10

from pipeline.geometry.mesh import RayMesh
from pipeline.model.tilt import TiltLaw
from pipeline.reconstruct.baselines.dipole import dipole_reflectance, fit_dipole, fit_dipole_laser
from pipeline.reconstruct.baselines.lambertian import fit_lambertian
from pipeline.reconstruct.global_term.completion import complete
from pipeline.reconstruct.global_term.prior import FAR, deviation
from pipeline.reconstruct.global_term.radial_profile import TILT_EDGES, fit_profile
from pipeline.reconstruct.samples.laser_samples import LaserSamples, scatter
from pipeline.reconstruct.samples.spots import tilts


def test_profile_is_recovered() -> None:
    made = make(noise=0.0, contrast=0.0, hidden=0.0)
    s = made.samples
    found = fit_profile(s.spot_pairs, LaserSamples.of(s, 0), s.edge, s.tilt)
    got = s.vertex_pairs.mean(found.profile)
    assert rmse_log10(0.5 * (got + got.T), made.truth[0]) < 0.02


def test_deviation_and_scatter_grow_with_distance() -> None:
    d = np.linspace(0, 40, 50)
    assert (np.diff(deviation(d, FAR)) >= 0).all()
    assert deviation(d, 0.3).max() == 0.3
    assert (np.diff(scatter(d)) > 0).all()


@pytest.mark.parametrize("absorption", [0.001, 0.1])
def test_dipole_energy_and_fit(absorption: float) -> None:
    """Rationale: the integral over the plane is Jensen's closed form; the fit returns what it was given."""
    scattering, eta = 1.5, 1.3
    r = np.geomspace(1e-4, 4e3, 200_000)
    total = np.trapezoid(2 * np.pi * r * dipole_reflectance(r, scattering, absorption, eta), r)
    inner = -1.440 / eta**2 + 0.710 / eta + 0.668 + 0.0636 * eta
    boundary = (1 + inner) / (1 - inner)
    albedo = scattering / (scattering + absorption)
    root = np.sqrt(3 * (1 - albedo))
    exact = albedo / 2 * (1 + np.exp(-4 / 3 * boundary * root)) * np.exp(-root)  # Jensen et al. 2001, eq. 15
    assert total == pytest.approx(exact, rel=2e-3)
    made = make(spots=40, noise=0.0, contrast=0.0, hidden=0.2)
    kernel = made.samples.spot_pairs.mean(lambda d: dipole_reflectance(d, scattering, absorption, eta))
    values = np.where(np.isfinite(made.samples.values), kernel, np.nan).astype(np.float32)
    found = fit_dipole_laser(replace(made.samples, values=values), 0)
    assert found == pytest.approx((scattering, absorption), rel=0.02)


def test_dipole_model_depends_on_distance_alone(small: Synthetic) -> None:
    model = fit_dipole(small.samples).terms[0]
    np.testing.assert_allclose(model.reflectance[0], model.reflectance[0].T, rtol=1e-6)


def test_lambertian_does_with_spots_that_are_hardly_seen() -> None:
    """A camera on the other side: no spot shows 30 % of its light, whose estimate is then what there is."""
    s = make(spots=20, hidden=0.0, noise=0.0).samples
    near = np.linalg.norm(s.spots.position[:, None] - np.asarray(s.mesh.vertices), axis=2) < 12
    (term,) = fit_lambertian(replace(s, values=np.where(near, np.nan, s.values).astype(np.float32))).terms
    assert np.isfinite(term.albedo).all() and (term.albedo > 0).all()


def test_lambertian_albedo_is_the_energy_of_the_spots(small: Synthetic) -> None:
    (term,) = fit_lambertian(small.samples).terms
    area = RayMesh.of(small.samples.mesh).vertex_areas
    albedo = term.albedo[0]
    truth = small.truth[0] @ area
    assert np.std(albedo / truth) < 0.08
    assert albedo.mean() == pytest.approx(truth.mean(), rel=0.03)


def test_baselines_are_not_misled_by_the_views(small: Synthetic) -> None:
    """Rationale: samples darker by the direction that they were seen from; the fits see through it."""
    s = make(spots=60, noise=0.0, contrast=0.0).samples
    tilt = np.random.default_rng(4).uniform(-0.8, 0.2, s.values[0].shape)
    leaning = replace(s, tilt=tilt, values=s.values * (1 + 0.5 * tilt).astype(np.float32))
    np.testing.assert_allclose(
        fit_lambertian(leaning).terms[0].albedo.mean(), fit_lambertian(s).terms[0].albedo.mean(), rtol=0.02
    )
    np.testing.assert_allclose(fit_dipole_laser(leaning, 0), fit_dipole_laser(s, 0), rtol=0.05)


def test_profile_is_that_of_all_directions() -> None:
    """Rationale: samples brighter where one looks along the light's way; the tilted fit takes it out again."""
    made = make(noise=0.0, contrast=0.0, hidden=0.0)
    s = made.samples
    tilt = np.random.default_rng(4).uniform(-0.8, 0.2, s.values[0].shape)
    seen = LaserSamples.of(replace(s, values=s.values * (1 + 0.5 * tilt).astype(np.float32)), 0)
    plain, tilted = (
        s.vertex_pairs.mean(fit_profile(s.spot_pairs, seen, s.edge, t).profile).sum() / made.truth[0].sum()
        for t in (np.zeros_like(tilt), tilt)
    )
    assert plain < 0.9
    assert tilted == pytest.approx(1.0, abs=0.01)


def test_tilt_has_the_sign_of_the_view() -> None:
    """Rationale: a camera far away along x sees the light of a spot at the pole of z along its way on the +x side."""
    s = make(spots=2).samples
    pole = replace(
        s.spots,
        position=np.array([[0, 0, 10.0]] * 2),
        normal=np.array([[0, 0, 1.0]] * 2),
        direction=np.array([[0, 0, -1.0], [-0.6, 0, -0.8]]),  # the second laser stands on the +x side
    )
    at_vertices, at_spots = tilts(s.mesh, pole, np.array([1e6, 0, 0]), 1.3)
    x, _, z = np.asarray(s.mesh.vertices).T
    near = (z > 8) & (np.abs(x) > 2)
    np.testing.assert_array_equal(np.sign(at_vertices[0, near]), np.sign(x[near]))
    np.testing.assert_allclose(at_spots[0, near], 0.0, atol=1e-9)
    np.testing.assert_array_equal(np.sign(at_spots[1, near]), -np.sign(x[near]))


def test_tilts_of_samples_are_reciprocal() -> None:
    """Rationale: spots on two vertices, lit and seen from far away, then each lit from where the other's camera was:
    light takes the same way back, so the sample has the same tilt, the law's only direction.
    """
    s, rng = make(spots=2).samples, np.random.default_rng(6)
    points, normals = np.asarray(s.mesh.vertices), np.asarray(s.mesh.vertex_normals)
    for _ in range(20):
        at = rng.choice(len(points), 2, replace=False)
        travel, towards = (x / np.linalg.norm(x) for x in rng.standard_normal((2, 3)))

        def tilt(way: list[int], direction: np.ndarray, eye: np.ndarray, at: np.ndarray = at) -> float:
            ends = at[way]
            spots = replace(s.spots, position=points[ends], normal=normals[ends], direction=np.stack([direction] * 2))
            leaving, entering = tilts(s.mesh, spots, 1e9 * eye, 1.3)
            return float((leaving + entering)[0, ends[1]])

        there = tilt([0, 1], travel, towards)
        assert tilt([1, 0], -towards, -travel) == pytest.approx(there, abs=1e-7)
        assert tilt([0, 1], -travel, -towards) == pytest.approx(-there, abs=1e-7)


def test_slopes_are_found_with_honest_errors() -> None:
    """Rationale: samples with a known law and known noise, forty times. Expected: z of the slopes about 1, no bias."""
    made = make(spots=60, noise=0.0, contrast=0.0, hidden=0.2)
    s, rng, z = made.samples, np.random.default_rng(3), []
    tilt = rng.uniform(-0.7, 0.4, s.values[0].shape)
    law = TiltLaw(s.edge * np.array(TILT_EDGES), np.array([0.1, 0.3, 0.6, 0.55, 0.4, 0.2, 0.1]))
    exact = s.values * law.factor(s.spot_pairs.distance, tilt)
    for _ in range(40):
        noisy = exact * (1 + 0.1 * rng.standard_normal(exact.shape))
        seen = replace(s, tilt=tilt, values=noisy.astype(np.float32), noise_per_signal=(0.01 * np.nan_to_num(exact)))
        found = fit_profile(s.spot_pairs, LaserSamples.of(seen, 0), s.edge, tilt)
        z.append((found.tilt.slope - law.slope) / np.sqrt(np.diag(found.covariance)))
    inner = np.array(z)[:, 1:-1]  # the profile's ends are not where the prior says
    assert np.abs(inner.mean(axis=0)).max() < 4 * 1.2 / np.sqrt(40)
    assert 0.7 < np.sqrt((inner**2).mean()) < 1.3


def test_an_object_without_a_tilt_is_left_alone() -> None:
    """Rationale: samples without an effect of direction, with noise, among views that lean to all sides."""
    s = make(spots=60, noise=0.05, contrast=0.0).samples
    tilt = np.random.default_rng(4).uniform(-0.7, 0.4, s.values[0].shape)
    model = complete(replace(s, tilt=tilt))
    assert model.terms[0].tilt is None
    assert "no change with direction" in model.provenance["without angular moments"]
    leaning = replace(s, tilt=tilt, values=s.values * (1 + 0.3 * tilt).astype(np.float32))
    (term,) = complete(leaning).terms
    np.testing.assert_allclose(term.tilt[0, 1:5], 0.3, atol=0.1)
    backward = complete(replace(s, tilt=tilt, values=s.values * (1 - 0.3 * tilt).astype(np.float32)))
    assert backward.terms[0].tilt is None  # no light goes back: errors of places are fitted, and not relit
    assert "without angular moments" in backward.provenance
