"""Angular moments: the fast sums against the plain double sum, closed forms, reciprocity, what does not change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from hw.base.arrays import F64
from pipeline.geometry.camera import PinholeCamera, look_at
from pipeline.geometry.fresnel import Boundary, along_surface, transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.model.tilt import TiltLaw
from pipeline.relight.irradiance import hat_moments, tilted_moments
from pipeline.relight.lights import Directional, Environment, Lobe, Uniform
from pipeline.relight.on_mesh import ViewOfMesh

MESH = trimesh.creation.icosphere(subdivisions=2, radius=15.0)
LAW = TiltLaw(np.array([1.0, 4.0, 16.0]), np.array([0.7, 0.4, 0.1]))
EYE = np.array([300.0, 80.0, 40.0])
CAMERA = PinholeCamera(48, 36, np.array([450.0, 450.0]), np.array([24.0, 18.0]), np.zeros(5), look_at(EYE, (0, 0, 0)))
SUN = Directional(direction=(-0.3, 1.0, 0.2))


def model(tilted: bool = True, mesh: trimesh.Trimesh = MESH, lasers: int = 2) -> RelightableModel:
    r = np.linalg.norm(mesh.vertices[:, None] - mesh.vertices[None], axis=2)
    reflectance = np.stack([np.exp(-r / (3.0 + k)) * 1e-2 for k in range(lasers)]).astype(np.float32)
    slopes = np.stack([LAW.slope * (1 - 0.2 * k) for k in range(lasers)])
    own = {"tilt": slopes, "tilt_distance": LAW.distance} if tilted else {}
    return RelightableModel(mesh, Boundary(1.3), (GlobalTerm(reflectance, np.ones(r.shape, bool), None, **own),))


def picture(of: RelightableModel, light: Directional | Uniform | Environment = SUN) -> np.ndarray:
    return of.image(of.lit_by(light), of.seen_by(CAMERA))


def plain_image(of: RelightableModel, light: Directional, laser: int) -> F64:
    """Pixel by ray by pair of vertices, with the formula as it stands, to first order, in float64."""
    term, mesh = of.terms[0], of.mesh
    assert isinstance(term, GlobalTerm)
    points, lit, view = np.asarray(mesh.vertices), of.lit_by(light), of.seen_by(CAMERA)
    law = TiltLaw(term.tilt_distance, term.tilt[laser])
    way = points[None] - points[:, None]
    r = np.linalg.norm(way, axis=2)
    way = way / np.where(r > 0, r, 1.0)[:, :, None]
    slope = law(r)
    q, *along = lit.tilted_flux[:, laser]
    entered = q[:, None] + slope * np.einsum("xi,iox->io", np.stack(along), way)
    scalar = (term.reflectance[laser] * entered).sum(axis=0)
    ahead = np.einsum("io,iox->ox", term.reflectance[laser] * slope * q[:, None], way)
    image = np.zeros(CAMERA.height * CAMERA.width)
    for rays in view.rays():
        corner = mesh.faces[rays.triangle]
        normal = RayMesh.of(mesh).smooth_normals(rays.triangle, rays.barycentric)
        t = along_surface(-rays.direction, normal, 1.3)
        value = (rays.barycentric * (scalar[corner] + np.einsum("nx,nkx->nk", t, ahead[corner]))).sum(axis=1)
        weight = transmittance(rays.cosine, 1.3) / np.pi / view.supersample**2
        image += np.bincount(rays.pixel, weight * value, len(image))
    return image.reshape(CAMERA.height, CAMERA.width)


def test_the_sums_are_the_plain_ones() -> None:
    of = model()
    for laser in (0, 1):
        plain = plain_image(of, SUN, laser)
        np.testing.assert_allclose(picture(of)[laser], plain, atol=1e-5 * plain.max())
    assert np.abs(picture(of) - picture(model(tilted=False))).max() > 0.01 * plain.max()


def test_slopes_of_zero_change_nothing() -> None:
    of = model()
    still = replace(of, terms=(replace(of.terms[0], tilt=np.zeros((2, 3))),))
    plain = picture(model(tilted=False))
    np.testing.assert_allclose(picture(still), plain, atol=1e-6 * plain.max())


def test_light_from_all_sides_knows_of_the_exit_alone() -> None:
    """Rationale: on a convex body t has no mean where light comes alike from everywhere; nor does e on a sphere."""
    lit = model().lit_by(Uniform())
    assert np.abs(lit.tilted_flux[1:]).max() < 0.02 * lit.flux.max()
    plain = picture(model(tilted=False), Uniform())
    assert np.abs(picture(model(), Uniform()) - plain).max() < 0.02 * plain.max()


def test_first_moments_of_a_sphere_are_those_of_the_closed_form() -> None:
    """Rationale: without refraction and for cos > 0, the integral of cos t over a sphere is pi r^2 / 2 ahead."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=10.0)
    total = tilted_moments(Directional(direction=(0, 0, -1)), mesh, Boundary(1.0), 1).sum(axis=2)[:, 0]
    np.testing.assert_allclose(total, [np.pi * 100, 0, 0, -np.pi * 50], atol=0.004 * np.pi * 100)


@pytest.mark.parametrize(
    "light", [SUN, Uniform(), Environment(lobes=(Lobe(direction=(0.2, 1, 0), sharpness=4.0, radiance=(1.0,)),))]
)
def test_moments_of_order_zero_are_the_hat_moments(light: Directional | Uniform | Environment) -> None:
    np.testing.assert_array_equal(
        tilted_moments(light, MESH, Boundary(1.3), 1)[0], hat_moments(light, MESH, Boundary(1.3), 1)
    )


def seen_from_afar(of: RelightableModel, travel: F64, towards: F64) -> float:
    """W/sr per W/mm^2 that a lit object sends to a camera: light flies along `travel`, the camera is where `towards`
    points, so far away that all its rays are parallel.
    """
    away, pixels, field = 2e4, 64, 34.0
    pose = look_at(tuple(away * towards), (0, 0, 0), (0.1, 0.2, 1.0))
    focal, centre = np.full(2, pixels * away / field), np.full(2, pixels / 2)
    camera = PinholeCamera(pixels, pixels, focal, centre, np.zeros(5), pose)
    image = of.image(of.lit_by(Directional(direction=tuple(travel))), of.seen_by(camera))
    return float(image[0].sum(dtype=np.float64)) * (field / pixels) ** 2


def flattened(subdivisions: int, tilted: bool = True) -> RelightableModel:
    """An ellipsoid whose R_d differs from side to side."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=15.0)
    mesh.vertices *= [1.0, 0.7, 0.5]
    points = np.asarray(mesh.vertices)
    side = np.exp(0.5 * np.sin(points[:, 0] / 5) * np.cos(points[:, 1] / 4 + 1))
    plain = model(tilted, mesh, 1)
    (term,) = plain.terms
    wide = term.reflectance**0.6 * 1e-2  # hats resolve it: 5 mm
    return replace(plain, terms=(replace(term, reflectance=wide * (side[:, None] * side).astype(np.float32)),))


def test_relit_objects_are_reciprocal() -> None:
    """Rationale: light and camera change places. What a lit object sends to a far camera, per irradiance, is what it
    sends back to where the light stood when it is lit from the camera (Helmholtz), whatever its shape and R_d, if the
    angular term does at the exit what it does at the entry. Light is projected onto hat functions at the entry and
    interpolated at the exit, which differ in second order: the difference falls to a quarter per refinement.

    Expected behaviour: extrapolated by that, both ways are equal to two thousandths: the fourth order is a sixteenth of
    the coarse mesh's difference, .018 at most. The term itself changes what is seen by a twelfth to an eighth; with one
    sign at the entry and the other at the exit the ways differ by as much.
    """
    rng, models = np.random.default_rng(3), [flattened(2), flattened(3)]
    turns = [x / np.linalg.norm(x, axis=1, keepdims=True) for x in rng.standard_normal((4, 2, 3))]
    for travel, towards in (turns[1], turns[3]):  # a tenth darker by the term, a sixth brighter
        coarse, fine = (
            np.log(seen_from_afar(of, travel, towards) / seen_from_afar(of, -towards, -travel)) for of in models
        )
        assert abs((4 * fine - coarse) / 3) < 2e-3
        effect = seen_from_afar(models[0], travel, towards) / seen_from_afar(flattened(2, False), travel, towards)
        assert abs(np.log(effect)) > 0.05


def test_turning_object_light_and_camera_together_changes_nothing() -> None:
    turn = trimesh.transformations.rotation_matrix(0.8, [1, 2, 3])
    mesh = MESH.copy()
    mesh.apply_transform(turn)
    pose = CAMERA.pose @ np.linalg.inv(turn)
    of, sun = model(mesh=mesh), Directional(direction=tuple(turn[:3, :3] @ SUN.direction))
    turned = of.image(of.lit_by(sun), ViewOfMesh(replace(CAMERA, pose=pose), mesh, of.boundary))
    np.testing.assert_allclose(turned, picture(model()), atol=2e-3 * turned.max())


def test_units_do_not_matter() -> None:
    """Rationale: the object ten times as large, seen from ten times as far: R_d a hundredth, radiance the same."""
    mesh, eye = MESH.copy(), replace(CAMERA, pose=look_at(tuple(10 * EYE), (0, 0, 0)))
    mesh.apply_scale(10.0)
    (term,) = model().terms
    grown = replace(term, reflectance=term.reflectance / 100, tilt_distance=10 * term.tilt_distance)
    of = RelightableModel(mesh, Boundary(1.3), (grown,))
    image = of.image(of.lit_by(SUN), of.seen_by(eye))
    np.testing.assert_allclose(image, picture(model()), atol=2e-3 * image.max())


def test_lights_that_are_prepared_together_give_the_same_images() -> None:
    """Bit for bit: the kernel is made once, its products are those of one light."""
    lights = [Directional(direction=(0.3, -0.2, -1)), Uniform()]
    view = model().seen_by(CAMERA)
    together, alone = model(), model()
    lit = [together.lit_by(light) for light in lights]
    together.prepare(lit)
    for light, own in zip(lights, lit, strict=True):
        np.testing.assert_array_equal(together.image(own, view), alone.image(alone.lit_by(light), view))
