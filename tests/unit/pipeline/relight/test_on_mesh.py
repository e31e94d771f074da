"""From radiosity to images: closed forms on a sphere and a plane, geometry, occlusion."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import trimesh
from scipy import sparse

from pipeline.geometry.camera import PinholeCamera, look_at
from pipeline.geometry.fresnel import Boundary, transmittance
from pipeline.relight import on_mesh
from pipeline.relight.lights import Uniform
from pipeline.relight.on_mesh import LightOnMesh, ViewOfMesh


def camera(position: tuple[float, float, float] = (450.0, 0.0, 80.0), focal: float = 1300.0) -> PinholeCamera:
    pose = look_at(position, (0, 0, 0))
    return PinholeCamera(96, 62, np.array([focal, focal]) / 2, np.array([48.0, 31.0]), np.zeros(5), pose)


def relit_image(radiosity: np.ndarray, mesh: trimesh.Trimesh, seen_by: PinholeCamera, **options: int) -> np.ndarray:
    return ViewOfMesh(seen_by, mesh, Boundary(1.3), **options).image(radiosity)


def test_a_sphere_of_constant_radiosity_shows_f_t() -> None:
    """Expected: L = F_t(w_o) / pi * B with the sphere's exact normals, falling to zero at the rim."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=20)
    mesh.vertices *= np.sqrt(4 * np.pi * 400 / mesh.area)  # the inscribed mesh is 0.1 % too small
    view = ViewOfMesh(camera(), mesh, Boundary(1.3))
    image = view.image(np.full((2, len(mesh.vertices)), 5.0))
    assert image.shape == (2, 62, 96)
    assert image.dtype == np.float32
    origins, directions = camera().rays(camera().pixel_centres(8))
    b = (origins * directions).sum(axis=1)
    square = b**2 - (origins**2).sum(axis=1) + 400
    points = origins + directions * (-b - np.sqrt(np.maximum(square, 0)))[:, None]
    exact = np.where(square > 0, transmittance(-(points * directions).sum(axis=1) / 20, 1.3), 0) * 5 / np.pi
    exact = exact.reshape(62, 8, 96, 8).mean(axis=(1, 3))
    assert np.sqrt(((image[0] - exact) ** 2).mean() / (exact**2).mean()) < 4e-3
    assert image[1].sum() == pytest.approx(exact.sum(), rel=1e-3)
    assert sum(len(rays.pixel) for rays in view.rays()) / 16 == pytest.approx((square > 0).sum() / 64, rel=2e-3)


def test_radiosity_is_linear_on_faces_and_seen_where_the_camera_projects_it() -> None:
    corners = np.array([[0, -30.0, -20], [0, 30, -20], [0, 30, 20], [0, -30, 20]])
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    distorted = replace(camera((450.0, 30.0, 80.0)), distortion=np.array([-0.9, 0.3, 0.01, -0.02, 0.0]))
    view = ViewOfMesh(distorted, mesh, Boundary(1.0), supersample=1)
    image = view.image((100 + corners @ [0, 2.0, -1.0])[None])[0]
    hits = np.concatenate([rays.pixel for rays in view.rays()])
    inside = np.argwhere(np.bincount(hits, minlength=62 * 96).reshape(62, 96) == 1)
    origins, directions = distorted.rays(inside[:, ::-1] + 0.5)
    points = origins - directions * (origins[:, :1] / directions[:, :1])
    expected = (100 + points @ [0, 2.0, -1.0]) / np.pi
    np.testing.assert_allclose(image[tuple(inside.T)], expected, rtol=1e-5)
    pixels, _ = distorted.project(points)
    np.testing.assert_allclose(pixels, inside[:, ::-1] + 0.5, atol=1e-6)
    assert len(inside) > 1000


def test_flat_faces_with_creases_keep_their_own_normals() -> None:
    box = trimesh.creation.box(extents=(20, 30, 24))
    image = relit_image(np.ones((1, 8)), box, camera((450.0, 0.0, 0.0), focal=2000.0))[0]
    assert image[31, 48] == pytest.approx(float(transmittance(1.0, 1.3)) / np.pi, rel=1e-4)
    assert image[31, 35:60].min() > 0.999 * image[31, 48]


def test_what_stands_in_front_hides_and_the_inside_is_black() -> None:
    near = trimesh.creation.box(extents=(2, 20, 20), transform=trimesh.transformations.translation_matrix([20, 0, 0]))
    far = trimesh.creation.box(extents=(2, 20, 20), transform=trimesh.transformations.translation_matrix([-20, 0, 0]))
    both = trimesh.util.concatenate([near, far])
    radiosity = np.concatenate([np.zeros(8), np.ones(8)])[None]
    image = relit_image(radiosity, both, camera((450.0, 0.0, 0.0)))
    assert image.max() == 0
    inverted = trimesh.Trimesh(near.vertices, near.faces[:, ::-1], process=False)
    assert relit_image(np.ones((1, 8)), inverted, camera()).max() == 0


def test_supersampling_converges_at_the_rim() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=20)
    radiosity = np.random.default_rng(0).random((1, len(mesh.vertices)))
    fine = relit_image(radiosity, mesh, camera(), supersample=16)
    errors = [np.abs(relit_image(radiosity, mesh, camera(), supersample=s) - fine).mean() for s in (1, 4)]
    assert errors[1] < errors[0] / 4


def test_a_view_keeps_its_matrix_and_not_its_rays() -> None:
    """Expected: bit for bit the matrix of all rays at once; what is kept is far smaller than the rays."""
    view = ViewOfMesh(camera(), trimesh.creation.icosphere(subdivisions=2, radius=20), Boundary(1.3))
    bands = list(view.rays())
    pixel, triangle, barycentric = (
        np.concatenate([getattr(b, n) for b in bands]) for n in ("pixel", "triangle", "barycentric")
    )
    share = (np.concatenate([view.weight(b) for b in bands])[:, None] * barycentric).ravel()
    at = np.repeat(pixel, 3), view.mesh.faces[triangle].ravel()
    whole = sparse.csr_matrix((share, at), shape=view.matrix.shape)
    for name in ("data", "indices", "indptr"):
        np.testing.assert_array_equal(getattr(view.matrix, name), getattr(whole, name))
    assert len(bands) > 2
    assert set(vars(view)) == {f.name for f in fields(view)} | {"matrix"}


def test_moments_and_flux_come_from_one_integration(monkeypatch: pytest.MonkeyPatch) -> None:
    found, asked = on_mesh.hat_moments, []
    monkeypatch.setattr(on_mesh, "hat_moments", lambda *a: asked.append(a) or found(*a))
    lit = LightOnMesh(Uniform(), trimesh.creation.box(extents=(20, 30, 24)), Boundary(1.3), 2)
    assert not asked
    assert lit.flux.shape == lit.moments.shape == (2, 8)
    assert lit.flux.sum() == pytest.approx(lit.moments.sum(), rel=1e-12)
    assert len(asked) == 1


def test_tilted_moments_hold_the_plain_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rationale: a model with directions asks for both. Expected: one integration, the same numbers either way."""
    mesh = trimesh.creation.box(extents=(20, 30, 24))
    plain = LightOnMesh(Uniform(), mesh, Boundary(1.3), 2)
    lit = LightOnMesh(Uniform(), mesh, Boundary(1.3), 2)
    expected, tilted = plain.flux, lit.tilted_flux
    monkeypatch.setattr(on_mesh, "hat_moments", None)
    np.testing.assert_array_equal(lit.flux, expected)
    np.testing.assert_array_equal(tilted[0], expected)
