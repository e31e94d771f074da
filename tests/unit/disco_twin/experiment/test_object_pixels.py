"""Which pixels show the object and how obliquely, on a sphere whose cosines are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scene_fakes import sphere

from disco_twin.experiment.object_pixels import RIM_COSINE, ObjectPixels
from pipeline.geometry.camera import PinholeCamera, look_at

EYE = np.array([900.0, 200.0, 100.0])
VIEW = PinholeCamera(96, 80, np.full(2, 1500.0), np.array([48.0, 40.0]), np.zeros(5), look_at(EYE, (0, 0, 0)))


def exact_cosine(radius: float) -> np.ndarray:
    """(H, W) at the pixels' centres, NaN beside the sphere."""
    origins, directions = VIEW.rays(VIEW.pixel_centres())
    along = (origins * directions).sum(axis=1)
    root = along**2 - (origins**2).sum(axis=1) + radius**2
    points = origins - directions * (along + np.sqrt(np.maximum(root, 0)))[:, None]
    cosine = -(points * directions).sum(axis=1) / radius
    return np.where(root > 0, cosine, np.nan).reshape(VIEW.height, VIEW.width)


def test_cosines_and_rim_of_a_sphere() -> None:
    """Expected behaviour: cosines as the sphere's own; the rim are the pixels whose mean cosine is below .2, inner and
    rim together the mask, which is the disc of half-filled pixels.
    """
    pixels = ObjectPixels.of(trimesh.creation.icosphere(subdivisions=5, radius=20.0), VIEW)
    exact = exact_cosine(20.0)
    clear = np.nan_to_num(exact) > 0.35
    np.testing.assert_allclose(pixels.cosine[clear], exact[clear], atol=0.01)
    assert abs(int(pixels.mask.sum()) - int(np.isfinite(exact).sum())) < 0.02 * pixels.mask.sum()
    assert not (pixels.rim & pixels.inner).any()
    np.testing.assert_array_equal(pixels.rim | pixels.inner, pixels.mask)
    # A ring of cosines from 0 to c is c^2 of the disc; pixels that are cut by the outline blur that.
    assert pixels.rim.sum() / pixels.mask.sum() == pytest.approx(RIM_COSINE**2, abs=0.02)
    assert np.nan_to_num(exact, nan=0.0)[pixels.rim].max() < RIM_COSINE + 0.15


def test_a_pixel_that_is_partly_filled_has_the_cosine_of_what_it_shows() -> None:
    """Rationale: a flat face seen from straight ahead: every cosine is nearly 1, in pixels at its edge, too."""
    straight = replace(VIEW, pose=look_at(np.array([900.0, 0.0, 0.0]), (0, 0, 0)))
    pixels = ObjectPixels.of(trimesh.creation.box(extents=(1.0, 30.2, 30.2)), straight)
    assert pixels.mask.any()
    assert pixels.cosine[pixels.cosine > 0].min() > 0.99
    assert not pixels.rim.any()


def test_an_experiment_keeps_what_it_has_worked_out() -> None:
    experiment = sphere()
    view = experiment.scene.relight.views[0]
    assert experiment.object_pixels(view) is experiment.object_pixels(view)
    assert experiment.object_pixels(view).mask.any()
