"""A homogeneous medium inside a scan: exact solutions in a sphere, energy, light across gaps, the fit to samples."""

from __future__ import annotations

from dataclasses import replace

import gpytoolbox
import numpy as np
import pytest
import trimesh
from numpy.polynomial.legendre import legval
from numpy.typing import NDArray
from reconstruct_synthetic import Synthetic, make, rmse_log10
from scipy.special import spherical_in

from pipeline.geometry.fresnel import mean_transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.reconstruct.global_term import completion
from pipeline.reconstruct.global_term.completion import complete
from pipeline.reconstruct.global_term.prior import FAR, LEAST_FAR, far_scatter, medium_priors
from pipeline.reconstruct.medium import diffusion as module
from pipeline.reconstruct.medium.diffusion import Diffusion
from pipeline.reconstruct.medium.medium_fit import FEWEST, NEAREST, MediumPrior, fit_medium
from pipeline.reconstruct.medium.tetrahedra import NoMedium, fill
from pipeline.reconstruct.samples.samples import Samples
from pipeline.reconstruct.samples.spots import Spots

F64 = NDArray[np.float64]
ETA, D, ABSORPTION, RADIUS = 1.3, 0.4, 0.004, 10.0


def leaving(eta: float = ETA) -> float:
    """Flux out per fluence rate: t / (2 (2 - t)), t of diffuse light from inside."""
    t = mean_transmittance(eta) / eta**2
    return t / (2 * (2 - t))


def sphere_fluence(cosine: F64, diffusivity: float = D, absorption: float = ABSORPTION, terms: int = 400) -> F64:
    """Fluence rate on a sphere per flux into a point of it: spherical harmonics, order by order, the point spread over
    a twentieth of the radius (which distances of more than a fifth do not see).
    """
    kappa = np.sqrt(absorption / diffusivity)
    order = np.arange(terms)
    inside, slope = spherical_in(order, kappa * RADIUS), spherical_in(order, kappa * RADIUS, derivative=True)
    ratio = np.where(inside > 0, kappa * slope / np.where(inside > 0, inside, 1.0), order / RADIUS)
    ratio = np.where(np.isfinite(ratio), ratio, order / RADIUS)
    smooth = np.exp(-order * (order + 1) * 0.05**2 / 2)
    weight = (2 * order + 1) / (4 * np.pi * RADIUS**2) * smooth / (diffusivity * ratio + leaving())
    return np.asarray(legval(cosine, weight))


def sphere(subdivisions: int) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)


def two_boxes(side: float, gap: float) -> trimesh.Trimesh:
    """Two closed slabs that face each other."""
    parts = []
    for sign in (-1, 1):
        box = trimesh.creation.box((side, side, side / 5)).subdivide().subdivide().subdivide()
        box.apply_translation((0, 0, sign * (gap / 2 + side / 10)))
        parts.append(box)
    return trimesh.util.concatenate(parts)


def test_light_between_facing_squares_is_that_of_their_form_factor() -> None:
    """Exact: parallel squares as far apart as they are wide exchange .19982 (Howell's catalogue, C-11)."""
    surface = RayMesh.of(two_boxes(10.0, 10.0))
    exchange = surface.exchange
    np.testing.assert_allclose(exchange.toarray(), exchange.toarray().T)
    assert exchange.sum() / (2 * 100.0) == pytest.approx(0.19982, rel=0.01)  # 49,152 directions: .9 % by chance
    np.testing.assert_allclose(surface.open_areas(1.0) + np.asarray(exchange.sum(axis=1)), surface.vertex_areas)
    np.testing.assert_allclose(surface.open_areas(0.0), surface.vertex_areas)


@pytest.mark.parametrize("gap", [0.3, 0.05])
def test_no_area_is_less_than_closed(gap: float) -> None:
    """Rationale: across a narrow gap all that leaves meets the mesh again; rays know that but for chance."""
    surface = RayMesh.of(two_boxes(10.0, gap))
    assert surface.open_areas(1.0).min() > 0


def test_a_convex_mesh_sees_nothing_of_itself() -> None:
    surface = RayMesh.of(sphere(2))
    assert surface.exchange.nnz == 0
    np.testing.assert_array_equal(surface.open_areas(1.0), surface.vertex_areas)


def test_the_tetrahedra_fill_the_scan() -> None:
    mesh = sphere(3)
    tets = fill(mesh)
    np.testing.assert_array_equal(tets.points[: len(mesh.vertices)], mesh.vertices)
    assert tets.volumes.sum() == pytest.approx(mesh.volume, rel=1e-6)
    place = tets.points @ np.array([0.3, -0.2, 0.5]) + 1.0  # a linear function has one gradient everywhere
    gradient = np.einsum("tdk,tk->td", tets.gradients, place[tets.corners])
    np.testing.assert_allclose(gradient, np.broadcast_to([0.3, -0.2, 0.5], gradient.shape), atol=1e-9)


def test_parts_across_a_gap_are_not_joined() -> None:
    mesh = two_boxes(10.0, 0.5)  # far less than an edge
    tets = fill(mesh)
    z = tets.points[tets.corners][:, :, 2]
    assert not ((z.min(axis=1) < 0) & (z.max(axis=1) > 0)).any()
    assert tets.volumes.sum() == pytest.approx(mesh.volume, rel=1e-3)


def test_without_absorption_all_that_enters_leaves() -> None:
    """Energy, on a mesh that faces itself: what leaves for good is what was put in, whatever D. What the surface
    reflects of light that meets it again leaves as well.
    """
    found = Diffusion.of(two_boxes(10.0, 3.0), ETA)
    sources = np.random.default_rng(1).uniform(0, 1, (len(found.surface), 3))
    fluence = found.solver(0.7, 0.0)(sources)[: len(found.surface)]
    np.testing.assert_allclose(leaving() * found.open_area @ fluence, sources.sum(axis=0), rtol=1e-8)


def test_light_crosses_the_air() -> None:
    """Rationale: two slabs that share nothing but the air; the first bounce is the flux that leaves the one, times the
    form factor and what the other lets in.
    """
    mesh = two_boxes(10.0, 10.0)
    found, surface = Diffusion.of(mesh, ETA), RayMesh.of(mesh)
    lower = np.asarray(mesh.vertices)[:, 2] < 0
    sources = np.where(lower, surface.vertex_areas, 0.0)[:, None]
    fluence = found.solver(0.7, 0.1)(sources)[: len(lower), 0]
    arriving = mean_transmittance(ETA) * leaving() * (surface.exchange @ np.where(lower, fluence, 0.0))
    alone = replace(found, surface=leaving() * np.diag(surface.vertex_areas))
    expected = alone.solver(0.7, 0.1)(arriving[:, None])[: len(lower), 0]
    assert fluence[~lower].sum() > 0
    second_bounce = 0.2**2
    assert fluence[~lower].sum() == pytest.approx(expected[~lower].sum(), rel=second_bounce)


def test_a_sphere_lit_evenly_converges_as_the_square_of_the_edge() -> None:
    """Exact: q / (D (kappa coth kappa R - 1 / R) + leaving)."""
    kappa = np.sqrt(ABSORPTION / D)
    exact = 1.0 / (D * (kappa / np.tanh(kappa * RADIUS) - 1 / RADIUS) + leaving())
    errors = []
    for subdivisions in (2, 3):
        mesh = sphere(subdivisions)
        found, area = Diffusion.of(mesh, ETA), RayMesh.of(mesh).vertex_areas
        fluence = found.solver(D, ABSORPTION)(area[:, None])[: len(area), 0]
        errors.append(abs((fluence @ area) / area.sum() / exact - 1))
    assert errors[1] < 0.01
    assert 2.0 < errors[0] / errors[1] < 8.0


def test_light_between_points_of_a_sphere_is_the_series_of_spherical_harmonics() -> None:
    """Expected: converging, and nearer than half of the least scatter that a prior is credited with."""
    misses = []
    for subdivisions in (2, 3):
        mesh = sphere(subdivisions)
        found, points = Diffusion.of(mesh, ETA), np.asarray(mesh.vertices) / RADIUS
        cosine = np.clip(points @ points.T, -1, 1)
        far = RADIUS * np.sqrt(2 - 2 * cosine) > 8.0  # two and a half of the coarser mesh's edges
        misses.append(np.log(found.between(D, ABSORPTION)[far] / sphere_fluence(cosine[far])))
    assert abs(misses[1].mean()) < LEAST_FAR / 5
    assert misses[1].std() < LEAST_FAR / 2
    assert misses[1].std() < misses[0].std() / 2


def test_a_large_scan_is_filled_coarsely(monkeypatch: pytest.MonkeyPatch) -> None:
    """Expected: the same light between the same vertices, from a quarter of the nodes."""
    fine = sphere(3)
    whole = Diffusion.of(fine, ETA).between(D, ABSORPTION)
    monkeypatch.setattr(module, "MOST_VERTICES", 200)
    coarse = Diffusion.of(fine, ETA)
    assert len(coarse.surface) <= 220
    carried = coarse.hats @ (coarse.hats @ coarse.between(D, ABSORPTION)).T
    far = np.linalg.norm(fine.vertices[:, None] - fine.vertices[None], axis=2) > 8.0
    miss = np.log(carried[far] / whole[far])
    assert abs(miss.mean()) < LEAST_FAR / 2
    assert miss.std() < LEAST_FAR


@pytest.fixture(scope="module")
def diffuse() -> Synthetic:
    """A sphere whose samples are those of a homogeneous medium, with 2 % noise."""
    base = make(subdivisions=3, spots=60, contrast=0.0, noise=0.02)
    rng = np.random.default_rng(3)

    def r_d(distance: F64) -> F64:
        return 0.2 * sphere_fluence(np.clip(1 - 0.5 * (distance / RADIUS) ** 2, -1, 1))

    exact = base.samples.spot_pairs.mean(r_d)[None]
    values = np.where(np.isfinite(base.samples.values), exact * (1 + 0.02 * rng.standard_normal(exact.shape)), np.nan)
    slope = 0.02**2 * np.nan_to_num(values)
    samples = base.samples.with_readings(values=values.astype(np.float32), noise_per_signal=slope.astype(np.float32))
    return Synthetic(samples, base.samples.vertex_pairs.mean(r_d)[None])


def test_the_fit_finds_a_medium_of_the_same_light(diffuse: Synthetic) -> None:
    """Expected: R_d at all distances within what elements of this size are off by, sampled or not. D, sigma_a and the
    level make up for each other; each is found within a factor of two.
    """
    samples = diffuse.samples
    elements = Diffusion.of(samples.mesh, ETA)
    found = fit_medium(samples, 0, elements)
    far = samples.vertex_pairs.distance > NEAREST * samples.edge
    light = found.level * elements.between(found.diffusivity, found.absorption)
    miss = np.log(light[far] / diffuse.truth[0][far])
    assert abs(miss.mean()) < LEAST_FAR / 2
    assert miss.std() < LEAST_FAR / 2
    assert 0.5 < found.diffusivity / D < 2.0
    assert 0.5 < np.sqrt(found.absorption / found.diffusivity) / np.sqrt(ABSORPTION / D) < 2.0


def test_departures_are_none_near_and_none_in_the_mean(diffuse: Synthetic) -> None:
    """Rationale: on a sphere distance says all."""
    samples = diffuse.samples
    found = Diffusion.of(samples.mesh, ETA)
    prior = MediumPrior.of(samples, found, fit_medium(samples, 0, found))
    near = samples.vertex_pairs.distance < 3.0 * samples.edge
    assert not prior.departures[near].any()
    assert np.std(prior.departures) < LEAST_FAR / 2
    np.testing.assert_allclose(prior.departures, prior.departures.T, atol=1e-9)
    assert np.std(prior.totals) < 0.01


def test_on_a_sphere_the_medium_is_left_out_with_its_reason(diffuse: Synthetic) -> None:
    media, far, because = medium_priors(diffuse.samples)
    assert media == []
    assert "distance alone" in because
    assert far < 0.2
    assert complete(diffuse.samples).provenance["without medium"] == because


def test_too_few_samples_show_no_medium(diffuse: Synthetic) -> None:
    samples = diffuse.samples
    values = samples.values.copy()
    values[:, 1:] = np.nan
    few = samples.with_readings(values=values)
    with pytest.raises(NoMedium, match=str(FEWEST)):
        fit_medium(few, 0, Diffusion.of(samples.mesh, ETA))
    assert medium_priors(few)[2].endswith("are needed")


def test_light_that_falls_too_steeply_for_the_elements_is_left_to_distance() -> None:
    """Rationale: R_d that falls by exp(-.9 d / edge) and faster; elements of an edge cannot follow it."""
    base = make(subdivisions=3, spots=60, contrast=0.0)
    samples = base.samples
    exact = samples.spot_pairs.mean(lambda d: np.exp(-0.9 * d / samples.edge) / (1 + (d / samples.edge) ** 2))[None]
    values = np.where(np.isfinite(samples.values), exact, np.nan).astype(np.float32)
    steep = samples.with_readings(values=values, noise_per_signal=(1e-4 * np.nan_to_num(values)).astype(np.float32))
    with pytest.raises(NoMedium, match="over an edge of the elements"):
        fit_medium(steep, 0, Diffusion.of(samples.mesh, ETA))


def test_without_absorption_the_fit_ends() -> None:
    """Rationale: sigma_a is then open downwards; the fit ends when the samples' expectations do not move any more."""
    base = make(subdivisions=3, spots=60, contrast=0.0)
    samples = base.samples

    def r_d(distance: F64) -> F64:
        return 0.2 * sphere_fluence(np.clip(1 - 0.5 * (distance / RADIUS) ** 2, -1, 1), absorption=1e-7)

    values = np.where(np.isfinite(samples.values), samples.spot_pairs.mean(r_d)[None], np.nan).astype(np.float32)
    clear = samples.with_readings(values=values, noise_per_signal=(1e-4 * np.nan_to_num(values)).astype(np.float32))
    elements = Diffusion.of(samples.mesh, ETA)
    found = fit_medium(clear, 0, elements)
    far = samples.vertex_pairs.distance > NEAREST * samples.edge
    light = found.level * elements.between(found.diffusivity, found.absorption)[far]
    assert np.log(light / r_d(samples.vertex_pairs.distance[far])).std() < LEAST_FAR / 2


@pytest.mark.parametrize("scatter", [0.25, 0.45])
def test_the_scatter_far_from_spots_is_that_of_the_object(diffuse: Synthetic, scatter: float) -> None:
    """Rationale: known log-normal deviations from the profile. Where noise hides all, FAR holds."""
    samples, rng = diffuse.samples, np.random.default_rng(5)
    values = samples.values * np.exp(scatter * rng.standard_normal(samples.values.shape)).astype(np.float32)
    assert far_scatter(samples.with_readings(values=values), 0) == pytest.approx(scatter, rel=0.1)
    loud = replace(samples, noise_per_signal=samples.noise_per_signal + np.nanmax(samples.values))
    assert np.isnan(far_scatter(loud, 0))
    assert medium_priors(loud)[:2] == ([], FAR)


def necked() -> trimesh.Trimesh:
    """Two bulbs and a neck of two fifths of their radius."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=7.0)
    points = np.array(mesh.vertices) * [1.0, 1.0, 2.5]
    points[:, :2] *= 1 - 0.6 * np.exp(-((points[:, 2:] / 4.0) ** 2))
    even = gpytoolbox.remesh_botsch(points, np.asarray(mesh.faces, np.int32), 20, 1.5, True)
    return trimesh.Trimesh(*even, process=False)


def test_light_through_a_neck_is_what_the_medium_says() -> None:
    """Rationale: pairs as far apart, on one side of the neck or across it, differ; distance alone cannot know."""
    mesh = necked()
    found = Diffusion.of(mesh, ETA)
    fluence = np.log(found.between(D, 0.004))
    z = np.asarray(mesh.vertices)[:, 2]
    distance = np.linalg.norm(mesh.vertices[:, None] - mesh.vertices[None], axis=2)
    alike = (distance > 9) & (distance < 11)
    across = alike & (z[:, None] > 3) & (z[None] < -3)
    within = alike & (z[:, None] > 6) & (z[None] > 6)
    assert fluence[within].mean() - fluence[across].mean() > 0.3


def test_noise_that_is_stated_too_large_is_no_evidence(diffuse: Synthetic) -> None:
    """Rationale: a ball, where distance says all; taking off more noise than there is leaves no scatter either way."""
    samples = diffuse.samples
    rng = np.random.default_rng(4)
    values = samples.values * (1 + 0.05 * rng.standard_normal(samples.values.shape)).astype(np.float32)
    loud = (0.15**2 * np.nan_to_num(values)).astype(np.float32)
    assert medium_priors(samples.with_readings(values=values, noise_per_signal=loud))[0] == []


def lit_by_a_medium(mesh: trimesh.Trimesh, absorptions: tuple[float, ...]) -> tuple[Samples, F64]:
    """60 spots, 2 % of noise, every third blind on one side; and the truth (L, V, V)."""
    rng, surface, spots = np.random.default_rng(8), RayMesh.of(mesh), 60
    triangle, barycentric = rng.permutation(len(mesh.faces))[:spots], rng.dirichlet(np.ones(3), spots)
    position, normal = surface.points(triangle, barycentric), surface.smooth_normals(triangle, barycentric)
    where = Spots(position, -normal, normal, triangle, barycentric, np.full(spots, 0.98), 0.5)
    elements = Diffusion.of(mesh, ETA)
    truth = 0.2 * np.stack([np.abs(elements.between(D, absorption)) for absorption in absorptions])
    shape = (len(absorptions), spots, surface.vertices)
    flat, empty = np.zeros(shape[1:]), np.full(shape, np.nan, np.float32)
    bare = Samples(mesh, ETA, where, empty, empty, empty, flat.astype(np.float32), flat, np.ones(shape[1:], np.float32))
    value = np.stack([bare.lit @ own for own in truth]) * (1 + 0.02 * rng.standard_normal(shape))
    for group, towards in enumerate(rng.standard_normal((3, 3))):
        depth = np.asarray(mesh.vertices) @ towards
        value[:, group::3, depth < np.quantile(depth, 0.3)] = np.nan
    noise = (0.02**2 * np.nan_to_num(value)).astype(np.float32)
    readings = {"values": value.astype(np.float32), "dark_variance": np.zeros(shape, np.float32)}
    return bare.with_readings(noise_per_signal=noise, **readings), truth


@pytest.mark.parametrize("vertices", [2000, pytest.param(400, marks=pytest.mark.slow)])
def test_a_medium_that_shows_fills_what_no_camera_saw(monkeypatch: pytest.MonkeyPatch, vertices: int) -> None:
    """Rationale: two bulbs and a neck, two wavelengths. Expected: the medium is taken, and far entries that nothing was
    measured next to come nearer to the truth, also where elements are coarser than the scan.
    """
    samples, truth = lit_by_a_medium(necked(), (0.004, 0.008))
    monkeypatch.setattr(module, "MOST_VERTICES", vertices)
    media, far, because = medium_priors(samples)
    assert len(media) == 2
    assert far < FAR
    assert because == ""
    left = []
    for chosen in (media, []):
        monkeypatch.setattr(completion, "medium_priors", lambda _, chosen=chosen: (chosen, far if chosen else FAR, ""))
        term = complete(samples).terms[0]
        hidden = ~term.measured & (samples.vertex_pairs.distance > 6 * samples.edge)
        left.append(rmse_log10(term.reflectance[:, hidden], truth[:, hidden]))
    assert left[0] < 0.8 * left[1]
