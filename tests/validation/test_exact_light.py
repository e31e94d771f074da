"""The error budget's images: exact light between ends that are diffuse, exact, or averaged over the scan's hats."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scene_fakes import sphere
from significance import assert_z, z_of_difference, z_of_replicates

from disco_twin.evaluate import exact_light
from disco_twin.evaluate.exact_light import ExactLight, best_curve
from disco_twin.experiment.experiment import Experiment
from disco_twin.light.truth import truth_columns
from pipeline.geometry.camera import PinholeCamera, look_at
from pipeline.geometry.fresnel import Boundary
from pipeline.reconstruct.global_term.boundary_fit import SeenRadiosity
from pipeline.reconstruct.samples.spots import Spots
from pipeline.relight.lights import Directional, Uniform
from pipeline.relight.on_mesh import LightOnMesh, ViewOfMesh

F64 = NDArray[np.float64]
REPLICATES, WALKS = 24, 20_000


@pytest.fixture(scope="module")
def ball() -> Experiment:
    """Homogeneous, rough, albedo .9, radius 20 mm; a scan of 162 vertices."""
    return sphere()


@pytest.fixture(scope="module")
def exact(ball: Experiment) -> ExactLight:
    return ExactLight(ball, 1.3, WALKS)


def on_hats(exact: ExactLight, power: list[F64]) -> F64:
    """(N, V) W at the scan's vertices of the first laser, both halves of each estimate as estimates of their own."""
    return np.concatenate([(exact.basis.T @ p[:, 0].T).T for p in power])


def test_under_uniform_light_a_diffuse_entry_is_exact(exact: ExactLight) -> None:
    """Rationale: from all around is what diffuse entry assumes. Expected: pi times the radiance arrives everywhere, and
    as much light leaves each hat function as when the photons come from afar.
    """
    density = exact.entering(Uniform())
    np.testing.assert_allclose(density, np.pi, rtol=5e-3)
    afar = [exact.power_of(Uniform(name=f"uniform {k}")) for k in range(REPLICATES // 2)]
    near = [exact.after_diffuse_entry(f"near {k}", np.full_like(density, np.pi))[1] for k in range(REPLICATES // 2)]
    assert_z(z_of_difference(on_hats(exact, afar), on_hats(exact, near)), "diffuse entry under uniform light")
    brighter = on_hats(exact, [1.03 * p for p in near]).sum(axis=1)
    assert abs(z_of_difference(on_hats(exact, afar).sum(axis=1), brighter)) > 5  # the test can fail


def test_light_in_parts_is_that_of_the_whole(exact: ExactLight, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rationale: between two parts Ctrl-C is obeyed, and progress reported. Expected: the same photons, none twice; no
    part is larger than was asked for.
    """
    camera = PinholeCamera(24, 24, np.full(2, 150.0), np.full(2, 12.0), np.zeros(5), look_at((200.0, 0, 0), (0, 0, 0)))
    density, told = exact.entering(Uniform()), list[int]()
    whole = exact.power_of(Uniform()), *exact.after_diffuse_entry("parts", density, [camera])
    monkeypatch.setattr(exact_light, "PHOTONS_AT_ONCE", 3000)
    monkeypatch.setattr(exact, "walked", told.append)
    parts = exact.power_of(Uniform()), *exact.after_diffuse_entry("parts", density, [camera])
    for one, other in zip(whole, parts, strict=True):
        assert one is not None and other is not None
        np.testing.assert_allclose(other, one, rtol=1e-5, atol=1e-6 * float(one.max()))
    assert sum(told) == 2 * WALKS and max(told) <= 3000


def test_negative_parts_of_a_density_are_taken_away(exact: ExactLight) -> None:
    """Consistent projections swing below zero beside shadows. Expected: light is linear."""
    half = (np.asarray(exact.mesh.vertices)[:, 0] > 0).astype(float)[None].repeat(3, axis=0)
    both = [exact.after_diffuse_entry(f"signed {k}", 2 * half - 1)[1] for k in range(REPLICATES // 2)]
    plus = [exact.after_diffuse_entry(f"plus {k}", half)[1] for k in range(REPLICATES // 2)]
    minus = [exact.after_diffuse_entry(f"minus {k}", 1 - half)[1] for k in range(REPLICATES // 2)]
    apart = on_hats(exact, plus) - on_hats(exact, minus)
    assert_z(z_of_difference(on_hats(exact, both), apart), "signed density")


def test_projections_onto_the_scan_keep_the_power(exact: ExactLight) -> None:
    power = np.random.default_rng(1).random((2, 3, len(exact.mesh.vertices)))
    total = power.sum(axis=2)
    for consistent in (False, True):
        radiosity = exact.radiosity_on_hats(power, consistent)
        np.testing.assert_allclose(radiosity @ (exact.basis.T @ exact.areas) * exact.mean, total, rtol=1e-9)
    even = exact.areas * exact.mean * np.ones((2, 3, 1))  # a radiosity of 1
    np.testing.assert_allclose(exact.radiosity_on_hats(even, False), 1.0, rtol=1e-12)
    np.testing.assert_allclose(exact.radiosity_on_hats(even, True), 1.0, rtol=1e-9)
    np.testing.assert_allclose(exact.radiosity(power) @ exact.areas * exact.mean, total, rtol=1e-9)


def test_the_best_curve_finds_the_curve_that_made_the_images(ball: Experiment) -> None:
    """Expected: a boundary of known ratio to 2 per cent, under a radiosity that varies over the surface."""
    camera = PinholeCamera.from_config(ball.scene.relight.views[0].model_copy(update={"width": 128, "height": 128,
        "pixel_pitch_um": ball.scene.relight.views[0].pixel_pitch_um / 4}))  # fmt: skip
    mesh, known = ball.object.mesh, Boundary(1.3, (0.0, 0.3, 1.0), (2.0, 1.2, 0.9))
    radiosity = 1.0 + 0.5 * np.sin(np.asarray(mesh.vertices)[:, :2].T / 5.0)
    image = np.asarray(ViewOfMesh(camera, mesh, known).image(radiosity), float)
    found = best_curve(mesh, 1.3, [SeenRadiosity(camera, image, radiosity)])
    at = np.array(found.cosines)
    expected = np.interp(at, known.cosines, known.ratio)
    np.testing.assert_allclose(np.array(found.ratio)[at > 0.1], expected[at > 0.1], rtol=0.02)


def test_the_spots_exact_responses_hold_all_the_light(ball: Experiment, exact: ExactLight) -> None:
    """Rationale: on a homogeneous ball every place answers alike. Expected: of the light that enters from all around
    over a beam's footprint as large a share leaves as of light that enters everywhere.
    """
    direction = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [-1.0, 0, 0], [0, -0.6, 0.8]]).repeat(5, axis=0)
    n = len(direction)
    spots = Spots(-20 * direction, direction, -direction, np.zeros(n, int), np.ones((n, 3)) / 3, np.ones(n), 1.0)
    value, variance = exact.spot_responses(spots)
    share = (value[0] * (exact.basis.T @ exact.areas)).sum(axis=1) * exact.mean**2
    assert (variance[0].sum(axis=1) > 0).all()
    whole = [exact.after_diffuse_entry(f"whole {k}", np.ones((3, len(exact.areas))))[1] for k in range(8)]
    out = on_hats(exact, whole).sum(axis=1) / exact.areas.sum()
    assert_z(z_of_difference(share, out), "share that leaves")
    assert abs(z_of_replicates(share, 0.9 * out.mean())) > 5


def test_light_on_hats_is_what_a_model_of_the_true_entries_relights(ball: Experiment, exact: ExactLight) -> None:
    """Rationale: the truth's entries are photons of another kind, launched hat by hat. Expected: a model that holds all
    of them has the radiosity that photons make which enter on the scan's hats and are averaged over them at the exit.
    """
    light = Directional(direction=(-0.6, 0.5, -0.6))
    flux = LightOnMesh(light, exact.scan, Boundary(1.3), 3).flux[0]
    lit = np.flatnonzero(np.abs(flux) > 1e-4 * flux.max())
    truth = [truth_columns(ball.transport, exact.basis, lit, 800, seed).replicates[:, 0] for seed in (1, 2)]
    modelled = flux[lit] @ np.concatenate(truth).astype(float) / exact.mean**2
    density = exact.entering_on_hats(light)
    powers = [exact.after_diffuse_entry(f"on hats {k}", density)[1] for k in range(REPLICATES // 2)]
    hats = np.concatenate([exact.radiosity_on_hats(power, consistent=False)[:, 0] for power in powers])
    seen = (hats > 0).mean(axis=0) > 0.9  # not where so few photons come that their number is no normal one
    assert seen.sum() > 60
    assert_z(z_of_difference(hats[:, seen], modelled[:, seen]), "radiosity")
    assert_z(z_of_difference(hats.sum(axis=1), modelled.sum(axis=1)), "all of it")
    projected = np.concatenate([exact.radiosity_on_hats(power, consistent=True)[:, 0] for power in powers])
    assert np.abs(z_of_difference(projected[:, seen], modelled[:, seen])).max() > 5  # no model of such entries


def test_lasers_whose_light_is_shaped_alike_share_their_photons() -> None:
    """Expected: one pattern for all, with the power of each; a pattern of each sign where the light changes sign; one
    for each laser where shapes differ; none for black light.
    """
    areas, shape = np.array([1.0, 2.0, 1.0]), np.array([1.0, 0.5, -0.5])
    up, down = exact_light._patterns(np.outer([1.0, 3.0], shape), areas)
    np.testing.assert_allclose(up.hat, [1.0, 0.5, 0.0])
    np.testing.assert_allclose(down.hat, [0.0, 0.0, 0.5])
    np.testing.assert_allclose(up.watts, [2.0, 6.0])
    np.testing.assert_allclose(down.watts, [-0.5, -1.5])
    apart = exact_light._patterns(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]), areas)
    assert [pattern.lasers.tolist() for pattern in apart] == [[0], [1]]
    assert not exact_light._patterns(np.zeros((3, 3)), areas)
