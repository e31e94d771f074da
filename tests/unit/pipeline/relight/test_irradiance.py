"""Irradiance and transmitted flux: closed forms, conservation, shadows, and a brute-force NumPy reference."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from plain_irradiance import irradiance
from scipy.integrate import dblquad

from hw.base.errors import InputError
from pipeline.geometry.camera import look_at
from pipeline.geometry.fresnel import Boundary, mean_transmittance, transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.relight.incident_light import from_many_directions
from pipeline.relight.irradiance import Accuracy, hat_moments
from pipeline.relight.lights import (
    Beam,
    Directional,
    Environment,
    Light,
    Lobe,
    TexturedProjector,
    Uniform,
    shipped_lights,
)
from pipeline.relight.on_mesh import LightOnMesh

F64 = NDArray[np.float64]


def transmitted_flux(light: Light, mesh: trimesh.Trimesh, eta: float, lasers: int) -> F64:
    return LightOnMesh(light, mesh, Boundary(eta), lasers).flux


def ball(subdivisions: int = 3, radius: float = 20.0) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)


def dented(subdivisions: int = 2) -> trimesh.Trimesh:
    mesh = ball(subdivisions, 1.0)
    x, y, z = mesh.vertices.T
    radius = 20 * (1 + 0.2 * np.sin(4 * x + 1) * np.sin(3 * y) + 0.15 * np.cos(5 * z + 2 * x))
    return trimesh.Trimesh(mesh.vertices * radius[:, None], mesh.faces, process=False)


def shelf(lower: float, upper: float, gap: float) -> trimesh.Trimesh:
    """Two flat square boxes (sides in mm), the upper one `gap` above the lower one, whose top is z = 0."""
    low = trimesh.creation.box(
        extents=(lower, lower, 2.0), transform=trimesh.transformations.translation_matrix([0, 0, -1])
    )
    high = trimesh.creation.box(
        extents=(upper, upper, 2.0), transform=trimesh.transformations.translation_matrix([0, 0, gap + 1])
    )
    return trimesh.util.concatenate([low, high])


# ---- closed forms on convex bodies


def test_uniform_light_on_a_convex_body_is_pi_l_tbar() -> None:
    mesh = ball()
    q = transmitted_flux(Uniform(radiance=2.0, colour=(1, 0.5, 0.25)), mesh, 1.3, 3)
    area = RayMesh.of(mesh).vertex_areas
    expected = 2 * np.pi * mean_transmittance(1.3) * np.outer([1, 0.5, 0.25], area)
    np.testing.assert_allclose(q, expected, rtol=1.5e-4)  # 256 directions; F_t is steep at grazing angles


def test_plain_irradiance_of_a_sphere_is_the_cosine() -> None:
    mesh = ball(4)
    points = mesh.triangles_center
    light = Directional(direction=(0, 0, -2), irradiance=3.0)
    e = irradiance(light, mesh, np.arange(len(points)), points, 1)[0]
    cosine = points[:, 2] / np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(e, 3 * np.maximum(cosine, 0), atol=0.03)  # faces tilt by up to h^2 / R^2
    np.testing.assert_allclose(irradiance(Uniform(), mesh, np.arange(9), points[:9], 2), np.pi, rtol=1e-12)


def test_directional_power_is_the_projected_area_and_converges_to_the_disc() -> None:
    errors = []
    for subdivisions in (2, 3, 4):
        mesh = ball(subdivisions)
        power = hat_moments(Directional(direction=(1, 2, -3), irradiance=2.0), mesh, 1.0, 1).sum()
        surface = RayMesh.of(mesh)
        towards = -np.array([1, 2, -3]) / np.sqrt(14)
        assert power == pytest.approx(2 * (surface.areas * np.maximum(surface.normals @ towards, 0)).sum(), rel=1e-9)
        errors.append(abs(power / (2 * np.pi * 400) - 1))
    assert 3.5 < errors[0] / errors[1] < 4.5  # second order in the edge length
    assert 3.5 < errors[1] / errors[2] < 4.5


def test_transmitted_directional_power_of_a_sphere() -> None:
    """Total through a smooth sphere: pi R^2 E 2 integral F_t(c) c dc = pi R^2 E Tbar, whatever the direction."""
    total = transmitted_flux(Directional(direction=(0.3, -1, 0.2)), ball(5), 1.3, 1).sum()
    assert total == pytest.approx(np.pi * 400 * mean_transmittance(1.3), rel=1e-3)


def test_distant_lobes_on_a_convex_body_see_its_projected_area() -> None:
    """Any far light of total integral(L dw) = S sends S times the projected area through a ball, here with eta = 1."""
    for sharpness in (1e-3, 2.0, 50.0, 5000.0):
        light = Environment(lobes=(Lobe(direction=(1, -2, 0.5), sharpness=sharpness, radiance=(1.5,)),))
        solid = 2 * np.pi * -np.expm1(-2 * sharpness) / sharpness
        mesh = ball(4)
        assert hat_moments(light, mesh, 1.0, 1).sum() == pytest.approx(1.5 * solid * np.pi * 400, rel=2e-3)


@pytest.mark.parametrize("light", [Beam(name="b", direction=(0.1, 0.2, -1), diameter_mm=d) for d in (0.5, 5.0, 8.0)])
@pytest.mark.parametrize("mesh", [ball(), trimesh.creation.box(extents=(40, 40, 20))], ids=["ball", "box"])
def test_a_beams_power_arrives_whole_even_on_large_triangles(light: Beam, mesh: trimesh.Trimesh) -> None:
    assert hat_moments(light, mesh, 1.0, 1).sum() == pytest.approx(1.0, rel=2e-3)


def test_half_planes_add_up_and_the_edge_lies_where_it_should() -> None:
    box = trimesh.creation.box(extents=(40, 40, 20))
    down = {"direction": (0, 0, -1), "edge_offset_mm": 4.0}
    lit = hat_moments(Directional(edge_side=(1, 0, 5), **down), box, 1.0, 1).sum()  # type: ignore[arg-type]
    assert lit == pytest.approx(40 * 16, rel=1e-3)


def test_projector_power_by_quadrature() -> None:
    light = TexturedProjector(position_mm=(0, 0, 300), up=(0, 1, 0), half_width_mm=9.3, intensity=1e5)
    pose = look_at(light.position_mm, light.aim_mm, light.up)

    def density(y: float, x: float) -> float:
        a, b, z = pose[:3, :3] @ [x, y, 0] + pose[:3, 3]
        wave = np.sin(2 * np.pi * a / 8) * np.sin(2 * np.pi * b / 8)
        r2 = a * a + b * b + z * z
        return float(1e5 * (1 + wave) / 2 * (z / np.sqrt(r2)) ** 3 / r2 * z / np.sqrt(r2))

    slab = trimesh.creation.box(extents=(40, 40, 2), transform=trimesh.transformations.translation_matrix([0, 0, -1]))
    top = np.flatnonzero(RayMesh.of(slab).normals[:, 2] > 0.9)
    points = np.array([[2.0, 2.0, 0], [-2, 2.0, 0], [9.5, 0, 0]])
    e = irradiance(light, slab, np.repeat(top[0], 3), points, 1)[0]
    np.testing.assert_allclose(e, [density(2, 2), density(2, -2), 0], rtol=1e-9)
    assert e[0] < 1e-3 * e[1] or e[1] < 1e-3 * e[0]  # a dark and a bright square of the pattern
    expected = dblquad(density, -9.3, 9.3, -9.3, 9.3, epsabs=1e-7)[0]
    assert hat_moments(light, slab, 1.0, 1).sum() == pytest.approx(expected, rel=1e-3)


# ---- shadows


def test_a_shadow_of_known_area() -> None:
    mesh = shelf(40, 17, gap=5)
    moments = hat_moments(Directional(direction=(0, 0, -1)), mesh, 1.0, 1)[0]
    assert moments[:8].sum() == pytest.approx(40**2 - 17**2, rel=1e-3)
    assert moments[8:].sum() == pytest.approx(17**2, rel=1e-9)


def test_a_roof_over_a_point_takes_its_form_factor() -> None:
    """A disc of radius r at height h above a point facing it blocks r^2 / (r^2 + h^2) of a uniform sky."""
    roof = trimesh.creation.cylinder(radius=10, height=1, sections=512)
    roof.apply_translation([0, 0, 8.5])
    floor = trimesh.creation.box(
        extents=(60, 60, 1), transform=trimesh.transformations.translation_matrix([0, 0, -0.5])
    )
    mesh = trimesh.util.concatenate([floor, roof])
    top = np.flatnonzero(RayMesh.of(mesh).normals[:12, 2] > 0.9)[0]
    e = irradiance(Uniform(), mesh, np.array([top]), np.zeros((1, 3)), 1)[0, 0]
    assert e == pytest.approx(np.pi * (1 - 100 / 164), rel=5e-3)


def hits_any(origins: F64, directions: F64, corners: F64) -> NDArray[np.bool_]:
    """Plain NumPy, all pairs: Moeller & Trumbore 1997. True where a ray meets a triangle beyond 1e-6 mm."""
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(directions[:, None], e2[None])
    det = np.einsum("fx,nfx->nf", e1, p)
    det = np.where(np.abs(det) < 1e-14, 1e-14, det)
    s = origins[:, None] - a[None]
    u = (s * p).sum(axis=2) / det
    q = np.cross(s, e1[None])
    v = np.einsum("nx,nfx->nf", directions, q) / det
    t = np.einsum("fx,nfx->nf", e2, q) / det
    return np.asarray(((u > 0) & (v > 0) & (u + v < 1) & (t > 1e-6)).any(axis=1))


def brute_force(light: Light, mesh: trimesh.Trimesh, eta: float, rng: np.random.Generator, count: int) -> F64:
    """(count, V) independent unbiased samples of the hat moments: one random point, one random direction each."""
    corners = mesh.vertices[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    face = rng.choice(len(area), count, p=area / area.sum())
    r1, r2 = np.sqrt(rng.random(count)), rng.random(count)
    bary = np.stack([1 - r1, r1 * (1 - r2), r1 * r2], axis=1)
    points, normals = np.einsum("nk,nkx->nx", bary, corners[face]), cross[face] / (2 * area[face, None])
    if isinstance(light, Environment):
        towards = rng.normal(size=(count, 3))
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        radiance = np.full(count, light.constant[0])
        for lobe in light.lobes:
            axis = np.array(lobe.direction) / np.linalg.norm(lobe.direction)
            radiance += lobe.radiance[0] * np.exp(lobe.sharpness * (towards @ axis - 1))
        arriving = 4 * np.pi * radiance
    elif isinstance(light, Beam):
        axis = np.array(light.direction) / np.linalg.norm(light.direction)
        towards = np.tile(-axis, (count, 1))
        distance = np.linalg.norm(np.cross(points - light.through_mm, axis), axis=1)
        arriving = (distance < light.diameter_mm / 2) * light.power_w * 4 / np.pi / light.diameter_mm**2
    else:
        assert isinstance(light, Directional)
        axis = np.array(light.direction) / np.linalg.norm(light.direction)
        towards, arriving = np.tile(-axis, (count, 1)), np.ones(count)
        if light.edge_side is not None:
            side = np.array(light.edge_side) - np.dot(light.edge_side, axis) * axis
            arriving = (points @ side / np.linalg.norm(side) > light.edge_offset_mm).astype(float)
    cosine = (towards * normals).sum(axis=1)
    value = arriving * transmittance(cosine, eta) * np.maximum(cosine, 0) * area.sum()
    ask = np.flatnonzero(value > 0)
    for part in np.array_split(ask, max(1, len(ask) // 500)):
        value[part] *= ~hits_any(points[part] + 1e-4 * normals[part], towards[part], corners)
    out = np.zeros((count, len(mesh.vertices)))
    np.put_along_axis(out, mesh.faces[face], bary * value[:, None], axis=1)
    return out


@pytest.mark.parametrize(
    "light",
    [
        Directional(direction=(1, 0.3, -0.4)),
        Directional(name="edge", direction=(1, 0.3, -0.4), edge_side=(0, 0.2, 1), edge_offset_mm=3.0),
        Beam(name="beam", direction=(0.2, 1, 0.1), through_mm=(2, 0, 3), diameter_mm=8.0),
        Environment(constant=(0.4,), lobes=(Lobe(direction=(0, 1, 1), sharpness=6.0, radiance=(2.0,)),)),
    ],
    ids=lambda light: str(light.name),
)
def test_flux_agrees_with_brute_force(light: Light) -> None:
    """Rationale: random points and directions, all triangles tested, none of the code under test but F_t.
    Expected: every vertex within its standard error, tested as one chi-squared and as the largest z-score.
    """
    mesh, count = dented(), 12_000
    moments = hat_moments(light, mesh, 1.3, 1)[0]
    samples = brute_force(light, mesh, 1.3, np.random.default_rng(5), count)
    seen = (samples > 0).sum(axis=0) > 25  # elsewhere the Gaussian says nothing
    z = (samples.mean(axis=0) - moments)[seen] / (samples.std(axis=0)[seen] / np.sqrt(count))
    assert seen.sum() > (4 if isinstance(light, Beam) else 40)
    total = (samples.sum(axis=1).mean() - moments.sum()) / (samples.sum(axis=1).std() / np.sqrt(count))
    assert abs(total) < 3.5
    assert np.abs(z).max() < 4.5
    assert (z**2).mean() < 1 + 4 * np.sqrt(2 / len(z))


# ---- the quadrature itself


def test_tolerance_bounds_the_error_and_buys_accuracy() -> None:
    mesh = dented()
    light = Beam(name="beam", direction=(0.2, 1, 0.1), diameter_mm=8.0)
    fine = hat_moments(light, mesh, 1.3, 1, Accuracy(1e-6, 12))
    errors = []
    for tolerance in (1e-2, 1e-3, 1e-4):
        rough = hat_moments(light, mesh, 1.3, 1, Accuracy(tolerance, 12))
        errors.append(np.abs(rough - fine).sum() / fine.sum())
        assert errors[-1] < 5 * tolerance
    assert errors[2] < 0.2 * errors[0]


def test_more_directions_converge_faster_than_random_ones() -> None:
    mesh, light = dented(), Uniform()
    fine = hat_moments(light, mesh, 1.3, 1, Accuracy(directions=2048))
    error = {
        n: float(
            np.sqrt(((hat_moments(light, mesh, 1.3, 1, Accuracy(directions=n)) - fine) ** 2).sum() / (fine**2).sum())
        )
        for n in (16, 256)
    }
    assert error[256] < 1e-3
    assert error[16] / error[256] > 6  # random directions: 4


def test_direction_sets_integrate_their_radiance() -> None:
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = Environment(constant=(2.0, 1.0), lobes=(Lobe(direction=(0, 0, -1), sharpness=9.0, radiance=(3.0, 1.0)),))
    for directions, weights in from_many_directions(light, normals, 64, 2):
        np.testing.assert_allclose(np.linalg.norm(directions, axis=2), 1, rtol=1e-12)
        assert weights.shape == (2, 50, 64)
    (constant, weight), _ = from_many_directions(light, normals, 64, 2)
    np.testing.assert_allclose(weight.sum(axis=2), np.array([[2 * np.pi], [np.pi]]) * np.ones(50), rtol=1e-12)
    cosine = np.einsum("nkx,nx->nk", constant, normals)
    np.testing.assert_allclose(cosine.mean(axis=1), 2 / 3, atol=3e-4)
    assert cosine.min() > 0
    for sharpness in (0.5, 3.0, 300.0):  # mean cosine of the von Mises-Fisher distribution
        lobe = Lobe(direction=(1, 2, 2), sharpness=sharpness, radiance=(1.0,))
        directions = from_many_directions(Environment(lobes=(lobe,)), normals[:1], 256, 1)[0][0][0]
        mean = directions.mean(axis=0)
        expected = (1 / np.tanh(sharpness) - 1 / sharpness) * np.array([1, 2, 2]) / 3
        np.testing.assert_allclose(mean, expected, atol=5e-3)


def test_turning_object_and_light_together_changes_nothing() -> None:
    mesh = dented()
    rotation = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.6, 0.3]))
    turned = trimesh.Trimesh(mesh.vertices @ rotation[:3, :3].T, mesh.faces, process=False)
    direction = np.array([1, 0.3, -0.4])
    before = hat_moments(Directional(direction=tuple(direction)), mesh, 1.3, 1)
    after = hat_moments(Directional(direction=tuple(rotation[:3, :3] @ direction)), turned, 1.3, 1)
    assert np.abs(after - before).sum() < 1e-3 * before.sum()


# ---- projection onto the vertices


def test_projection_keeps_the_total_and_a_constant_density() -> None:
    mesh = dented()
    light = Directional(direction=(1, 0.3, -0.4))
    lit = LightOnMesh(light, mesh, Boundary(1.3), 1)
    moments, q = lit.moments, lit.flux
    np.testing.assert_array_equal(moments, hat_moments(light, mesh, 1.3, 1))
    assert q.sum() == pytest.approx(moments.sum(), rel=1e-12)
    surface = RayMesh.of(mesh)
    np.testing.assert_allclose(np.asarray(surface.mass_matrix.sum(axis=1)).ravel(), surface.vertex_areas)
    dense = np.zeros((len(mesh.vertices),) * 2)
    for face, area in zip(mesh.faces, mesh.area_faces, strict=True):
        dense[np.ix_(face, face)] += area / 12 * (1 + np.eye(3))  # integrals of products of barycentric coordinates
    np.testing.assert_allclose(q[0], dense.sum(axis=1) * np.linalg.solve(dense, moments[0]), rtol=1e-9, atol=1e-9)
    flat = transmitted_flux(Uniform(), ball(), 1.0, 1)[0]  # density pi everywhere
    np.testing.assert_allclose(flat, np.pi * RayMesh.of(ball()).vertex_areas, rtol=1e-10)


def test_mass_projection_relights_better_than_hat_weights() -> None:
    """Rationale: R_d(d) = exp(-d / 4) / 1 mm^2 on a sphere, R averaged over hats as the truth is; the radiosity that
    each projection gives against the exact integral's own hat averages (docs/decisions/0005).
    Expected: the mass matrix at least halves the error of a smooth light.
    """
    mesh = ball(2)
    surface = RayMesh.of(mesh)
    fine = trimesh.creation.icosphere(subdivisions=4, radius=20).vertices
    hit = surface.first_hit(3 * fine, -fine / 20)
    face, bary = hit.triangle, hit.barycentric
    hats = np.zeros((len(fine), surface.vertices))
    np.put_along_axis(hats, surface.faces[face], bary, axis=1)
    area = hats.sum(axis=0)
    kernel = np.exp(-np.linalg.norm(fine[:, None] - fine[None], axis=2) / 4)
    averaged = hats.T @ kernel @ hats / np.outer(area, area)  # [u, v]
    density = np.maximum(fine @ [0.6, 0, 0.8], 0) / 20
    exact = hats.T @ (kernel @ density) / area
    moments = hats.T @ density
    mass = area * np.linalg.solve(hats.T @ hats, moments)
    error = [np.linalg.norm(averaged.T @ q - exact) / np.linalg.norm(exact) for q in (moments, mass)]
    assert error[1] < 0.5 * error[0]


# ---- lights


def test_shipped_lights_are_the_seven_and_behind_is_behind() -> None:
    camera = (150.0, 400.0, 110.0)
    lights = shipped_lights(camera)
    names = [light.name for light in lights]
    assert names == ["uniform", "directional", "edge", "behind", "projector", "spot", "environment"]
    behind = lights[3]
    assert isinstance(behind, Beam)
    towards = -np.array(behind.direction)
    cosine = towards @ camera / np.linalg.norm(towards) / np.linalg.norm(camera)
    assert np.degrees(np.arccos(cosine)) == pytest.approx(125, abs=0.01)
    mesh = dented(3)
    for light in lights:
        moments = hat_moments(light, mesh, 1.3, 3)
        assert moments.shape == (3, len(mesh.vertices))
        assert (moments.sum(axis=1) > 0).all()


def test_too_few_colours_are_refused() -> None:
    with pytest.raises(InputError, match=r"'uniform'.*3 lasers"):
        hat_moments(Uniform(colour=(1.0,)), ball(1), 1.3, 3)
    with pytest.raises(ValueError, match="zero vector"):
        Directional(direction=(0, 0, 0))
