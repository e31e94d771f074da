"""Every watt is accounted for, and extreme objects give the answers that they must."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from significance import assert_z, z_of_replicates
from twins import beam, block, camera, escaped, twin

from disco_twin.light import walk
from disco_twin.light.sources import HatSource, light_source
from disco_twin.light.transport import EnergyBalance, Transport
from disco_twin.object.build import Medium, TwinBoundary, TwinObject
from pipeline.relight.lights import Uniform

F64 = NDArray[np.float64]
REPLICATES = 32


def assert_balanced(balance: EnergyBalance, inside: float = 1e-5) -> None:
    """What the terms leave is rounding; next to nothing is cut off or leaks."""
    assert np.abs(balance.residual).max() < 1e-6, balance
    assert np.all(balance.inside <= inside * balance.launched), balance
    for term in ("reflected", "escaped", "absorbed", "boundary"):
        assert np.all(getattr(balance, term) >= -1e-7 * balance.launched), balance
    assert np.abs(balance.roulette / balance.launched).max() < 0.02, balance


def veined_medium(mesh: trimesh.Trimesh, lasers: int = 3) -> Medium:
    """A coarse random grid with strong contrast, also in sigma_t: null collisions occur."""
    random = np.random.default_rng(7)
    sigma_t = np.repeat(random.uniform(0.3, 4.0, (1, 5, 6, 7)), lasers, axis=0).astype(np.float32)
    albedo = random.uniform(0.7, 1.0, (lasers, 5, 6, 7)).astype(np.float32)
    low, high = np.asarray(mesh.bounds, float)
    return Medium(sigma_t, albedo, low - 0.1, high + 0.1, (0.4,) * lasers)


@pytest.mark.parametrize("kind", ["rough", "smooth", "matched"])
def test_balance(kind: str) -> None:
    """Rationale: launched + roulette = reflected + escaped + absorbed + boundary + inside, for each wavelength.

    Expected behaviour: the residual is at the level of single precision; the deposits hold what escaped (a convex
    object) within the quanta's rounding; a smooth or matched boundary loses nothing.
    """
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=4.0)
    boundary = TwinBoundary(kind, 1.0 if kind == "matched" else 1.4, 0.3 if kind == "rough" else 0.0)  # type: ignore[arg-type]
    transport = Transport(TwinObject(mesh, boundary, veined_medium(mesh)), cells=64)

    def light(group: object) -> object:
        return light_source(Uniform(), transport.radius, (0, 1, 2))

    traced = transport.trace(light, 1, 100_000, seed=21, deposit=True)
    balance = traced.balance
    assert_balanced(balance)
    assert traced.deposits is not None
    assert np.abs(traced.deposits[0].sum(axis=1) / balance.escaped - 1).max() < 1e-5
    if kind == "rough":
        assert np.all(balance.boundary > 0)
    else:
        assert np.abs(balance.boundary / balance.launched).max() < 1e-7


def test_roulette_creates_nothing_in_the_mean() -> None:
    """Rationale: Russian roulette trades weight for photons; a survivor's weight that is wrong is lost in the noise of
    every other tally.

    Expected behaviour: the balance's roulette term has the mean zero, for the wavelength that decides and for the
    weaker one that comes along, z-scores from 32 replicates.
    """
    transport = Transport(twin(block(40.0, 10.0), "matched", 1.0, 10.0, [0.9, 0.8]), cells=64)
    terms = []
    for seed in range(REPLICATES):
        balance = transport.trace(beam(), 1, 10_000, seed=seed).balance
        assert np.all(balance.roulette != 0)
        terms.append(balance.roulette)
    assert np.std(terms, axis=0).max() / math.sqrt(REPLICATES) < 1.5e-4
    assert_z(z_of_replicates(terms), "roulette")


def smith(cosine: F64, alpha: float) -> F64:
    """GGX shadowing of one direction (Walter et al. 2007, eq. 34)."""
    cosine = np.abs(cosine)
    return np.asarray(2 * cosine / (cosine + np.sqrt(cosine**2 + alpha**2 * (1 - cosine**2))))


def expected_loss(alpha: float, eta: float, mu: float) -> float:
    """Share of the power that Walter's single-scatter model drops for light that comes at cosine `mu`, in float64.

    Integral over the visible normals m of 1 - F G1(reflected) - (1 - F) G1(refracted), where a direction on the wrong
    side counts as shadowed; `eta` is the relative index of the side that the light goes to.
    """
    u, w = np.polynomial.legendre.leggauss(300)
    u, w = (u + 1) / 2, w / 2
    # u -> 1 - (1 - u)^3 crowds nodes at grazing normals.
    u, w = 1 - (1 - u) ** 3, w * 3 * (1 - u) ** 2
    phi = (np.arange(256) + 0.5) / 256 * math.pi
    tangent = alpha * np.sqrt(u / (1 - u))[:, None]
    cos_m = 1 / np.sqrt(1 + tangent**2)
    mx, mz = cos_m * tangent * np.cos(phi), cos_m * np.ones_like(phi)
    c = np.sqrt(1 - mu**2) * mx + mu * mz  # cosine between the light and m
    visible = w[:, None] / len(phi) / cos_m * smith(np.array(mu), alpha) * np.maximum(c, 0) / mu
    sine2 = (1 - c**2) / eta**2
    ct = np.sqrt(np.maximum(1 - sine2, 0))
    rs, rp = (c - eta * ct) / (c + eta * ct), (eta * c - ct) / (eta * c + ct)
    fresnel = np.where((sine2 >= 1) | (c <= 0), 1.0, (rs**2 + rp**2) / 2)
    up = 2 * c * mz - mu
    down = (c / eta - ct) * mz - mu / eta
    kept = fresnel * np.where(up > 0, smith(up, alpha), 0) + (1 - fresnel) * np.where(down < 0, smith(down, alpha), 0)
    assert abs(visible.sum() - 1) < 2e-3
    return float((visible * (1 - kept)).sum() / visible.sum())


def sampled_loss(alpha: float, eta: float, mu: float, inside: bool, n: int = 1 << 17) -> tuple[float, float, float]:
    """The same from Mitsuba's own sampling, as the walk uses it: mean, standard error, largest weight."""
    bsdf = mi.load_dict(
        {"type": "roughdielectric", "int_ior": eta, "ext_ior": 1.0, "alpha": alpha, "distribution": "ggx"}
    )
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(round(1e6 * mu) + inside, n)
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = mi.Vector3f(float(np.sqrt(1 - mu**2)), 0.0, float(-mu if inside else mu))
    context = mi.BSDFContext(mi.TransportMode.Importance)
    _, value = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), True)
    weight = np.array(value[0], np.float64)
    return float(1 - weight.mean()), float(weight.std() / math.sqrt(n)), float(weight.max())


ROUGHNESSES = (0.05, 0.1, 0.3, 0.5)
COSINES = (0.1, 0.3, 0.5, 0.7, 0.9, 1.0)


@pytest.mark.parametrize("alpha", ROUGHNESSES)
def test_furnace_of_the_rough_boundary(alpha: float) -> None:
    """Rationale: Walter's single-scatter model drops what the microfacets would scatter twice; the balance's boundary
    term is this loss, and it must be known per roughness.

    Expected behaviour: Mitsuba's sampling loses, at every angle and from both sides, what a float64 quadrature of the
    model says (z-test), and no weight exceeds one: energy is never created.
    """
    z = []
    for inside in (False, True):
        for mu in COSINES:
            loss, error, largest = sampled_loss(alpha, 1.3, mu, inside)
            expected = expected_loss(alpha, 1 / 1.3 if inside else 1.3, mu)
            assert largest <= 1 + 1e-4
            assert 0 <= expected < 1
            z.append((loss - expected) / math.hypot(error, 2e-4))
    assert_z(z, f"alpha {alpha}")


@pytest.mark.parametrize("alpha", ROUGHNESSES)
def test_first_meeting_in_a_furnace(alpha: float) -> None:
    """Rationale: the walk's boundary term for a perfectly black inside is the loss of the first meeting alone.

    Expected behaviour: a convex black body under cosine-weighted light loses the hemispherical mean of the model's
    loss, and nothing escapes from below.
    """
    x, w = np.polynomial.legendre.leggauss(24)
    mu = (x + 1) / 2
    mean = float(sum(m * k * expected_loss(alpha, 1.3, m) for m, k in zip(mu, w, strict=True)))
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=4.0)
    transport = Transport(twin(mesh, "rough", 1.3, 1e3, [0.0], alpha=alpha), cells=64)
    shares = []
    for seed in range(16):
        balance = transport.trace(furnace_of(transport, 1), 1, 20_000, seed=seed).balance
        assert_balanced(balance)
        assert balance.escaped[0] < 2e-3  # within a free path of an edge, light may cross a corner
        shares.append(balance.boundary[0])
    assert_z(z_of_replicates(shares, mean), f"alpha {alpha}")


def furnace_of(transport: Transport, tags: int) -> object:
    """Cosine-weighted light evenly over the whole surface, 1 W a tag."""

    def make(group: list[int]) -> HatSource:
        return HatSource(transport.vertices, transport.faces, np.ones((tags, len(transport.vertices))), len(group))

    return make


# Extreme objects. Right answers: see each test.


def nested() -> trimesh.Trimesh:
    """A sphere with a spherical cavity: the inner shell is inverted."""
    inner = trimesh.creation.icosphere(subdivisions=3, radius=2.0)
    inner.invert()
    return trimesh.util.concatenate([trimesh.creation.icosphere(subdivisions=3, radius=4.0), inner])


SHAPES = {
    "torus": lambda: trimesh.creation.torus(5.0, 2.0, major_sections=48, minor_sections=24),
    "cavity": nested,
    "plate": lambda: trimesh.creation.box(extents=[30.0, 30.0, 0.05]).subdivide().subdivide(),
    "rod": lambda: trimesh.creation.box(extents=[0.8, 0.8, 120.0]).subdivide().subdivide().subdivide(),
}


@pytest.mark.parametrize("kind", ["matched", "smooth"])
@pytest.mark.parametrize("shape", sorted(SHAPES))
def test_equilibrium_in_even_light(shape: str, kind: str) -> None:
    """Rationale: in even light from everywhere, an object that absorbs nothing is in equilibrium, whatever its shape,
    scattering and inner walls: radiance is the same everywhere (times eta^2 below the surface). That holds for concave
    shapes, cavities, plates thinner than a cell of the distance field, and rods, on every patch of the surface.

    Expected behaviour: the power that leaves through each patch, cavity walls included, is pi * radiance *
    Tbar(eta) * area; z-scores from 32 replicates for each octant of each shell. Nothing is absorbed.
    """
    from pipeline.geometry.fresnel import mean_transmittance

    mesh = SHAPES[shape]()
    eta = 1.0 if kind == "matched" else 1.4
    low, high = np.asarray(mesh.bounds, float)
    sigma_t = np.random.default_rng(3).uniform(0.2, 2.0, (1, 4, 4, 4)).astype(np.float32)
    medium = Medium(sigma_t, np.ones_like(sigma_t), low - 0.1, high + 0.1, (0.5,))
    transport = Transport(TwinObject(mesh, TwinBoundary(kind, eta, 0.0), medium), cells=64)  # type: ignore[arg-type]
    light = Uniform(radiance=1.0)
    traced = transport.trace(
        lambda group: light_source(light, transport.radius, group), REPLICATES, 20_000, seed=41, deposit=True
    )
    assert_balanced(traced.balance)
    assert traced.balance.absorbed[0] == 0
    assert traced.deposits is not None
    area = np.bincount(mesh.faces.ravel(), np.repeat(mesh.area_faces / 3, 3), minlength=len(mesh.vertices))
    vertices = np.asarray(mesh.vertices)
    patch = (vertices > 1e-9) @ [1, 2, 4] + 8 * (np.linalg.norm(vertices, axis=1) < 2.1) * (shape == "cavity")
    used = np.flatnonzero(np.bincount(patch))
    power = np.stack([traced.deposits[:, 0, patch == k].sum(axis=1) for k in used], axis=1)
    expected = math.pi * np.array([area[patch == k].sum() for k in used]) * mean_transmittance(eta)
    assert_z(z_of_replicates(power, expected), f"{shape}, {kind}")


def test_albedo_zero() -> None:
    """Black inside: nothing that entered comes back from a thick block; e^-tau passes straight through a thin one."""
    for kind in ("matched", "rough"):
        transport = Transport(twin(block(40.0, 10.0), kind, 1.3, 10.0, [0.0]), cells=64)
        balance = transport.trace(beam(), 1, 50_000, seed=51).balance
        assert_balanced(balance)
        assert balance.escaped[0] == 0
        if kind == "matched":
            assert balance.absorbed[0] == 1
    transport = Transport(twin(block(40.0, 0.7), "matched", 1.0, 1.0, [0.0]), cells=64)
    power, _ = escaped(transport, beam(), 1, 200_000, seed=52)
    share = math.exp(-np.float32(0.7))
    assert_z((power[0, 0] - share) / math.sqrt(share * (1 - share) / 200_000), "e^-tau")


def test_photons_that_are_cut_off_are_counted_and_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Rationale: a walk ends after MAX_STEPS meetings with the surface, here after three, whatever it still carries.

    Expected behaviour: what left, plus what is counted as inside, is what was launched, and one line says how much is
    lost; with the shipped limit nothing is, and nothing is said.
    """
    transport = Transport(twin(block(20.0, 5.0), "smooth", 1.5, 2.0, [1.0]), cells=64)
    whole = transport.trace(beam(), 1, 20_000, seed=59, deposit=True)
    assert whole.balance.inside[0] == 0
    assert not caplog.records
    monkeypatch.setattr(walk, "MAX_STEPS", 3)
    cut = transport.trace(beam(), 1, 20_000, seed=59, deposit=True)
    assert cut.deposits is not None
    lost = cut.balance.inside[0]
    assert lost > 0.05
    assert np.abs(cut.balance.residual).max() < 1e-6
    assert cut.deposits.sum() + cut.balance.reflected[0] + lost == pytest.approx(1.0, abs=1e-5)
    assert f"{lost:.2g} of the launched power is lost" in caplog.text


def test_albedo_one() -> None:
    """Nothing is absorbed: all that enters comes out again, however often it scatters."""
    for kind in ("matched", "smooth", "rough"):
        transport = Transport(twin(block(20.0, 5.0), kind, 1.3, 10.0, [1.0]), cells=64)
        balance = transport.trace(beam(), 1, 20_000, seed=53).balance
        assert_balanced(balance)
        assert balance.absorbed[0] == 0
        if kind == "matched":
            assert abs(balance.escaped[0] - 1) < 1e-6
        if kind != "rough":
            assert abs(balance.escaped[0] + balance.reflected[0] - 1) < 1e-6


@pytest.mark.parametrize("sigma_t", [0.0, 1e-6])
def test_clear_inside(sigma_t: float) -> None:
    """Hardly any medium. Matched: all light passes straight on. Smooth: a plate of glass, whose far face passes
    (1 - r) / (1 + r) of a normal beam and whose near face returns 2 r / (1 + r), r at its first surface.
    """
    transport = Transport(twin(block(20.0, 5.0), "matched", 1.0, sigma_t, [0.9]), cells=64)
    power, traced = escaped(transport, beam(), 1, 20_000, seed=54)
    assert_balanced(traced.balance)
    assert power[0, 0] == pytest.approx(1.0, abs=2e-5)
    r, walks = (0.5 / 2.5) ** 2, 200_000
    transport = Transport(twin(block(20.0, 5.0), "smooth", 1.5, sigma_t, [0.9]), cells=64)
    traced = transport.trace(beam(), 1, walks, seed=55, deposit=True)
    assert_balanced(traced.balance)
    assert traced.deposits is not None
    low = transport.vertices[:, 2] < -1.0
    share = (1 - r) / (1 + r)
    through = traced.deposits[0, 0, low].sum()
    assert_z((through - share) / math.sqrt(share * (1 - share) / walks), "through the plate")
    assert_z((traced.balance.reflected[0] - r) / math.sqrt(r * (1 - r) / walks), "first surface")


def test_optical_thickness_of_ten_thousand() -> None:
    """A half-space again: 1000 mean free paths a millimetre must reflect like 10 (exact values, `half_spaces`)."""
    for kind, n, exact in (("matched", 1.0, (0.414947, 0.752721)), ("smooth", 1.5, (0.219919, 0.561981))):
        transport = Transport(twin(block(20.0, 10.0), kind, n, 1000.0, [0.9, 0.99]), cells=64)  # type: ignore[arg-type]
        power, traced = escaped(transport, beam(REPLICATES), REPLICATES, 10_000, seed=56)
        assert_balanced(traced.balance)
        assert_z(z_of_replicates(power, exact), f"n = {n}")


def layer(albedo: float, tau: float, cells: int = 400) -> tuple[float, float]:
    """Reflected and transmitted share of a normal beam on a layer with isotropic scattering and no boundary.

    Collision density C(t) = e^-t + c int C(t') E1(|t - t'|) / 2 dt', by collocation in the middle of cells, with the
    kernel integrated exactly over each; light leaves with E2 / 2 of the distance to the face.
    """
    from scipy.special import expn

    edge = np.linspace(0, tau, cells + 1)
    middle = (edge[1:] + edge[:-1]) / 2
    integral = np.sign(edge - middle[:, None]) * (1 - expn(2, np.abs(edge - middle[:, None])))
    kernel = np.diff(integral, axis=1) / 2
    first = -np.diff(np.exp(-edge)) / np.diff(edge)
    density = np.linalg.solve(np.eye(cells) - albedo * kernel, first) * np.diff(edge)
    back = albedo * (density * expn(2, middle)).sum() / 2
    forth = albedo * (density * expn(2, tau - middle)).sum() / 2
    return float(back), float(forth + math.exp(-tau))


@pytest.mark.parametrize("depth", [0.004, 0.1, 1.0])
def test_plate_thinner_than_a_cell(depth: float) -> None:
    """A wide plate of 10 mean free paths a millimetre; a cell of the distance field measures .7 mm.

    Expected behaviour: reflection and transmission of the integral equation of radiative transfer. The thinnest plate
    is but fifty times as deep as the offset that keeps rays off the surface they left.
    """
    transport = Transport(twin(block(40.0, depth), "matched", 1.0, 10.0, [0.9]), cells=64)
    traced = transport.trace(beam(REPLICATES), REPLICATES, 60_000 if depth < 0.1 else 20_000, seed=57, deposit=True)
    assert_balanced(traced.balance)
    assert traced.deposits is not None
    low = transport.vertices[:, 2] < -depth / 2
    power = np.stack([traced.deposits[:, 0, ~low].sum(axis=1), traced.deposits[:, 0, low].sum(axis=1)], axis=1)
    assert_z(z_of_replicates(power, layer(0.9, 10 * depth)), f"depth {depth}")


def test_light_that_misses() -> None:
    """A beam beside the object is all reflected, in the balance's sense that it never entered; images stay dark."""
    transport = Transport(twin(block(10.0, 5.0), "rough", 1.3, 2.0, [0.9]), cells=64)
    view = camera((0.0, 10.0, 400.0), 20.0, 8)
    traced = transport.trace(beam(origin=(30.0, 0.0, 50.0)), 1, 1000, seed=58, cameras=[view], deposit=True)
    assert traced.balance.reflected[0] == 1
    assert traced.images is not None
    assert traced.deposits is not None
    assert not traced.images.any()
    assert not traced.deposits.any()
