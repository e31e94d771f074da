"""Factorised terms against the dense ones: near entries exact, the stated bound above every error and not far above."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import cdist

from hw.base.arrays import F32, F64
from hw.base.errors import InputError
from pipeline.geometry.camera import PinholeCamera, look_at
from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.mesh import RayMesh
from pipeline.model.factorise import Truncation, factorised, near_patches, patches
from pipeline.model.factorised import FactorisedTerm
from pipeline.model.lambertian import LambertianTerm
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.model.term import Axes, Term
from pipeline.model.tilt import TiltLaw, tilt_kernel
from pipeline.relight.lights import Directional
from pipeline.relight.on_mesh import LightOnMesh, ViewOfMesh

CUT = Truncation(near=60, patch=10, rank=5)


def dense(tilted: bool = True, lasers: int = 2) -> RelightableModel:
    """A lopsided ball of 162 vertices with a dark side, away from the origin, its entries with errors of their own."""
    mesh, rng = trimesh.creation.icosphere(subdivisions=2, radius=10.0), np.random.default_rng(3)
    mesh.vertices = mesh.vertices * [1.0, 0.8, 0.7] + [30.0, 0.0, -5.0]
    points = np.asarray(mesh.vertices)
    distance = cdist(points, points)
    dark = np.exp(-0.5 * (points[:, 2] > -3))
    noise = 1 + 0.05 * rng.standard_normal((lasers, *distance.shape))
    entries = 0.05 * np.exp(-distance / np.array([2.0, 4.0])[:lasers, None, None]) * np.outer(dark, dark) * noise
    entries = (entries + entries.transpose(0, 2, 1)).astype(np.float32)
    laws = {"tilt": np.tile([1.0, 0.6, 0.3], (lasers, 1)), "tilt_distance": np.array([1.0, 4.0, 12.0])}
    term = GlobalTerm(entries, np.ones(distance.shape, bool), **(laws if tilted else {}))
    return RelightableModel(mesh, Boundary(1.3), (term,))


MODEL = dense()
FAST = factorised(MODEL, CUT)
AREA, POINTS = RayMesh.of(MODEL.mesh).vertex_areas, np.asarray(MODEL.mesh.vertices, np.float64)


def fast_term(model: RelightableModel) -> FactorisedTerm:
    (term,) = model.terms
    assert isinstance(term, FactorisedTerm)
    return term


def left_of_tilt(laser: int) -> F64:
    """(3, V, V) what is left of the operator from first moments to radiosity, on densities: dense, entry by entry."""
    term = MODEL.terms[0]
    assert isinstance(term, GlobalTerm) and term.tilt is not None and term.tilt_distance is not None
    exact = tilt_kernel(term.reflectance[laser], cdist(POINTS, POINTS), TiltLaw(term.tilt_distance, term.tilt[laser]))
    left = exact - fast_term(FAST).tilt_kernels[laser](np.eye(len(AREA)))
    way = POINTS[None] - POINTS[:, None]
    return np.moveaxis(left[..., None] * way * np.sqrt(np.outer(AREA, AREA))[..., None], -1, 0)


def off(flux: F64) -> F64:
    """(4, L) rms over the surface of the factorised radiosity less the dense one."""
    error = fast_term(FAST).radiosity(flux, POINTS) - MODEL.terms[0].radiosity(flux, POINTS)  # type: ignore[attr-defined]
    return np.sqrt((error**2 * AREA).sum(axis=2) / AREA.sum())


def test_near_entries_are_exact_and_far_ones_held_to_their_own_size() -> None:
    centred = POINTS - POINTS.mean(axis=0)  # as they are rounded there: the ball has many equal gaps
    columns, patch = np.arange(0, len(AREA), 7), patches(centred, CUT.patch)
    assert 0.7 * CUT.patch < np.bincount(patch).min() <= np.bincount(patch).max() <= CUT.patch
    close, pair = near_patches(centred, patch, CUT.near)
    near = np.zeros((len(AREA),) * 2, bool)
    near[pair[0], pair[1]] = near[pair[1], pair[0]] = True
    assert 0.5 * CUT.near < near.sum(axis=1).mean() <= CUT.near
    np.testing.assert_array_equal(near, close[patch][:, patch])
    distance = cdist(POINTS, POINTS)
    assert near[distance < 2.5].all()
    error = np.abs(FAST.reflectance_columns(columns).mean / MODEL.reflectance_columns(columns).mean - 1)
    assert error[:, near[columns]].max() < 1e-6
    assert 0.005 < np.median(error[:, ~near[columns]]) < 0.05  # entries' own errors are 4 %
    dark = distance[columns] > 16
    assert np.median(error[:, dark]) < 0.05


def test_the_bound_is_above_the_norm_of_what_is_left_and_not_far_above() -> None:
    """The norms of the dense differences, by their singular values."""
    term, every = fast_term(FAST), np.arange(len(AREA))
    left = MODEL.reflectance_columns(every).mean - FAST.reflectance_columns(every).mean
    norms = np.linalg.norm(left * np.sqrt(np.outer(AREA, AREA)), 2, axis=(1, 2))
    tilted = [np.linalg.norm(np.concatenate(left_of_tilt(laser)), 2) for laser in range(2)]
    for bound, norm in ((term.error, norms), (term.tilt_error, tilted)):
        assert bound is not None
        assert (bound >= norm).all()
        assert (bound <= 1.5 * np.asarray(norm)).all()


@pytest.mark.parametrize("kind", ["broad", "spot", "worst", "along"])
def test_no_light_is_off_by_more_than_its_bound(kind: str) -> None:
    """Also the flux that what is left amplifies most, of either operator."""
    rng, count = np.random.default_rng(5), len(AREA)
    flux = np.zeros((4, 2, count))
    if kind == "broad":
        flux[0] = AREA * (1 + 0.5 * POINTS[:, 2] / 10)
        flux[1:] = 0.3 * flux[:1]
    elif kind == "spot":
        flux[:, :, 11] = rng.standard_normal((4, 2))
    else:
        for laser in range(2):
            if kind == "worst":
                every = np.arange(count)
                left = (MODEL.reflectance_columns(every).mean - FAST.reflectance_columns(every).mean)[laser]
                flux[0, laser] = np.sqrt(AREA) * np.linalg.eigh(left * np.sqrt(np.outer(AREA, AREA)))[1][:, -1]
            else:
                u = np.linalg.svd(np.concatenate(left_of_tilt(laser)), full_matrices=False)[0][:, 0]
                flux[1:, laser] = np.sqrt(AREA) * u.reshape(3, count)
    error, bound = off(flux), fast_term(FAST).error_bound(flux, AREA)
    # float32 of products whose terms cancel
    assert (error <= bound + 2e-6 * np.abs(MODEL.terms[0].radiosity(flux, POINTS)).max()).all()  # type: ignore[attr-defined]
    if kind == "along":
        assert (error[0] > 0.5 * bound[0]).all()


def test_lit_images_agree() -> None:
    light = Directional(direction=(-1.0, 0.5, -0.5), colour=(1.0, 0.5))
    camera = PinholeCamera(40, 30, np.array([600.0, 600.0]), np.array([20.0, 15.0]), np.zeros(5),
                           look_at((330.0, 60.0, 40.0), (30.0, 0.0, -5.0), (0.0, 0.0, 1.0)))  # fmt: skip
    lit, seen = LightOnMesh(light, MODEL.mesh, MODEL.boundary, 2), ViewOfMesh(camera, MODEL.mesh, MODEL.boundary)
    exact, fast = MODEL.image(lit, seen), FAST.image(lit, seen)
    assert np.linalg.norm(fast - exact) < 0.01 * np.linalg.norm(exact) != 0


def test_all_ranks_leave_nothing() -> None:
    whole = factorised(dense(tilted=False), Truncation(near=1, patch=8, rank=8))
    assert not fast_term(whole).by_direction
    flux = np.random.default_rng(1).standard_normal((1, 2, 162))
    exact = dense(tilted=False).terms[0].radiosity(flux, POINTS)  # type: ignore[attr-defined]
    np.testing.assert_allclose(fast_term(whole).radiosity(flux, POINTS), exact, rtol=0, atol=1e-5 * exact.max())


def test_a_lambertian_surface_is_a_diagonal() -> None:
    albedo = np.random.default_rng(2).random((2, len(AREA))).astype(np.float32)
    fast = fast_term(factorised(replace(MODEL, terms=(LambertianTerm(albedo),))))
    flux = np.random.default_rng(1).random((1, 2, len(AREA)))
    np.testing.assert_allclose(fast.radiosity(flux, POINTS)[0], flux[0] * albedo / AREA, rtol=1e-6)
    assert (fast.error_bound(flux, AREA) == 0).all()


def test_files_hold_factorised_models(tmp_path: Path) -> None:
    FAST.save(tmp_path / "fast.npz")
    again = fast_term(RelightableModel.load(tmp_path / "fast.npz").of_lasers([1, 0]))
    np.testing.assert_array_equal(again.basis[1], fast_term(FAST).basis[0])
    assert factorised(FAST).terms == FAST.terms
    bad = replace(fast_term(FAST), pair=fast_term(FAST).pair + 1)
    with pytest.raises(ValueError, match="vertices that are not there"):
        replace(FAST, terms=(bad,))
    with pytest.raises(ValueError, match="patches that are not there"):
        replace(FAST, terms=(replace(fast_term(FAST), patch=fast_term(FAST).patch + 1),))
    with pytest.raises(ValueError, match="come together"):
        replace(FAST, terms=(replace(fast_term(FAST), tilt_error=None),))


@dataclass(frozen=True)
class Unheard(Term):
    """A kind of term that nothing factorises."""

    kind = "unheard"
    value: Annotated[F32, Axes("laser", "1")]

    def image(self, light: LightOnMesh, view: ViewOfMesh) -> F32:
        raise NotImplementedError


def test_an_unknown_kind_of_term_is_refused_in_one_line() -> None:
    with pytest.raises(InputError, match=r"terms = 'unheard': .*allowed: global, lambertian.*Remedy: relight with"):
        factorised(replace(MODEL, terms=(Unheard(np.ones(2, np.float32)),)))
