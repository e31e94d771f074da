"""White balance and laser power, spot peaks, and the scanned surface."""

from __future__ import annotations

from collections.abc import Sequence

import gpytoolbox
import numpy as np
import pytest
import trimesh
from calibrate_twin import experiment, faulty_rig
from scipy.spatial import cKDTree

from disco_twin.faults.light_faults import LaserPower
from disco_twin.object.scanner import LARGEST_MM, NOISE_MM, geometry_error, scan_points
from hw.base.arrays import F64
from pipeline.calibrate.peaks import brightness, find_peak, footprint, seen
from pipeline.calibrate.photometric import PLACE_FREEDOM, PLACE_SHARE, balance, pixel_areas, with_places
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.surface_from_points import reconstruct_surface


def test_areas_of_pixels_add_up_to_the_plane() -> None:
    """A 20 mm square of a tilted plane: the areas of the pixels that it fills add up to its area."""
    camera = PinholeCamera.from_config(faulty_rig().cameras[0]).seen_from(np.eye(4))
    plane = np.eye(4)
    c, s = np.cos(0.6), np.sin(0.6)
    plane[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    plane[:3, 3] = [2.0, -1.0, 430.0]
    areas = pixel_areas(camera, plane)
    fine = 4
    xy = camera.undistort((camera.pixel_centres(fine) - camera.centre) / camera.focal)
    rays = np.column_stack([xy, np.ones(len(xy))])
    depth = (plane[:3, 3] @ plane[:3, 2]) / (rays @ plane[:3, 2])
    local = (rays * depth[:, None] - plane[:3, 3]) @ plane[:3, :3]
    inside = (np.abs(local[:, :2]).max(axis=1) < 10.0).reshape(camera.height, fine, camera.width, fine)
    assert (areas * inside.mean(axis=(1, 3))).sum() == pytest.approx(400.0, rel=2e-3)


def test_power_is_known_although_it_drifts() -> None:
    """Warm-up, blue noise and the green mode hop: the light drifts by a tenth and more, the power is known to .5 %."""
    rig = faulty_rig()
    faults = rig.faults.model_copy(update={"warm_up": True, "blue_noise": True, "mode_hop": True})
    power, rng = LaserPower(rig.lasers, faults, 7), np.random.default_rng(0)
    times = np.concatenate([np.linspace(0, 20, 40), np.linspace(200, 300, 40)])
    watts = np.array([[power.watts(laser, t) for t in times] for laser in range(3)])
    gain = np.array([1.03, 0.98, 1.01])
    reading = watts * 0.97 * (1 + 1e-3 * rng.standard_normal(watts.shape))
    light = 0.5 / np.pi * watts * gain[:, None] * (1 + 1e-3 * rng.standard_normal(watts.shape))
    found = balance(light, reading, np.full(3, 0.5), np.repeat([0, 1], 40))
    assert (found.drift > 0.1).all()
    assert (found.scatter < 0.005).all()
    assert np.abs((found.factor - 0.97 / gain) / found.error).max() < 4
    broken = balance(light, reading[::-1], np.full(3, 0.5), np.repeat([0, 1], 40))  # lasers in the wrong order
    assert np.abs(broken.factor * gain / 0.97 - 1).max() > 0.005
    assert (balance(light, np.full_like(reading, 0.01), np.full(3, 0.5), np.repeat([0, 1], 40)).scatter > 0.005).any()


def balance_scores(places: int, spreads: Sequence[float]) -> float:
    """Root mean square of z for rigs of two cameras, one for each spread of the places: 22 exposures a place, .8 % of
    speckle.
    """
    rng, scores = np.random.default_rng(2), []
    place = np.repeat(np.arange(places), 22)
    for spread in spreads:
        cameras = []
        for _ in range(2):
            apart = (1 + spread * rng.standard_normal(places))[place]
            light = 0.005 / np.pi * apart * (1 + 0.008 * rng.standard_normal((3, len(place))))
            cameras.append(balance(light, np.full_like(light, 0.01), np.full(3, 0.5), place))
        scores += [(found.factor - 1) / found.error for found in with_places(cameras)]
    return float(np.sqrt(np.mean(np.square(scores))))


@pytest.mark.parametrize("places", [2, 3, 6])
def test_the_white_balances_error_is_right_for_the_places_that_it_expects(places: int) -> None:
    """Spreads as the prior of `place_variance` has them. Expected: z-scores of 1, to the error of 600 rigs."""
    spreads = np.abs(PLACE_SHARE * np.random.default_rng(3).standard_t(PLACE_FREEDOM, 600))
    assert balance_scores(places, spreads.tolist()) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("places", [2, 3, 6])
@pytest.mark.parametrize("spread", [0.0, 0.0005, 0.001])
def test_the_white_balances_error_is_honest_where_places_differ(places: int, spread: float) -> None:
    """Rationale: a plate's pose errs alike for all exposures and lasers of a place, by shares that speckle hides or
    not. Expected: an rms of .8 to 1.25 for spreads up to five times what it expects (beyond, two places do not tell).
    """
    assert 0.8 < balance_scores(places, [spread] * 300) < 1.25


def test_one_place_tells_nothing_of_what_places_differ_by() -> None:
    """The prior alone is left: .09 % beside .17 % of speckle over 22 exposures, and no more with ten times as many."""
    rng = np.random.default_rng(4)
    for exposures in (22, 220):
        light = 0.005 / np.pi * (1 + 0.008 * rng.standard_normal((3, exposures)))
        alone = balance(light, np.full_like(light, 0.01), np.full(3, 0.5), np.zeros(exposures, int))
        added = np.sqrt(with_places([alone])[0].error ** 2 - alone.error**2) / alone.factor
        np.testing.assert_allclose(added, 9e-4, rtol=0.05)


def blob(x: float, y: float, width: float, height: float, shape: tuple[int, int] = (60, 80)) -> np.ndarray:
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    return height * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * width**2))


def test_a_peak_is_found_below_a_pixel_and_beside_noise() -> None:
    image = blob(30.3, 21.8, 2.5, 1.0) + 0.05
    image[5, 5] = 40.0  # one bright pixel is no spot
    peak = find_peak(image)
    np.testing.assert_allclose(peak.pixel, [30.3, 21.8], atol=0.05)
    assert np.abs(find_peak(image).pixel - [30.8, 22.3]).max() > 0.4  # half a pixel would be seen


def test_a_hidden_spot_is_recognised() -> None:
    """It only glows: fainter than spots that are seen, or far wider."""
    bright = [find_peak(blob(20 + k, 30, 2.5, 1.0)) for k in range(8)]
    faint, wide = find_peak(blob(40, 30, 2.5, 0.02)), find_peak(blob(40, 30, 15.0, 0.8))
    cut = find_peak(blob(1.0, 30, 2.5, 1.0))
    peaks = [*bright, faint, wide, cut]
    visible = seen(peaks, np.ones(11), 6.0, brightness(peaks, np.ones(11)))
    assert visible.tolist() == [True] * 8 + [False] * 3


def distance_mm(mesh: trimesh.Trimesh, points: F64) -> F64:
    """(N,) of points from a mesh."""
    faces = np.array(mesh.faces, np.int32)
    return np.asarray(gpytoolbox.signed_distance(points, np.array(mesh.vertices), faces)[0], np.float64)


def test_a_scan_becomes_a_mesh_of_nearly_equal_triangles() -> None:
    fine = experiment().object.mesh
    points, normals = scan_points(fine, 3)
    mesh = reconstruct_surface(points, normals, 1600)
    areas = mesh.area_faces
    assert abs(len(mesh.vertices) / 1600 - 1) < 0.03
    assert areas.std() / areas.mean() < 0.3
    assert mesh.is_watertight
    sampled, _ = trimesh.sample.sample_surface(mesh, 5000, seed=0)
    distance = np.abs(trimesh.proximity.ProximityQuery(fine).vertex(sampled)[0])
    assert np.sqrt((distance**2).mean()) < 0.35  # to the nearest vertex only: an upper bound
    off = distance_mm(mesh, points)
    assert np.sqrt((off**2).mean()) == pytest.approx(NOISE_MM, rel=0.15)
    patches = off[cKDTree(points).query(points[::50], 200)[1]].mean(axis=1)
    assert np.sqrt((patches**2).mean()) < 0.11  # what the mesh does not follow is below the scanner's own error


def test_the_scanner_errs_as_the_thesis_says() -> None:
    points = np.asarray(experiment().object.mesh.vertices)[::8]
    errors = np.array([geometry_error(points, np.random.default_rng(s)) for s in range(40)])
    assert np.sqrt((errors**2).mean()) == pytest.approx(0.1, rel=0.1)
    assert np.clip(errors, -LARGEST_MM, LARGEST_MM).max() <= LARGEST_MM
    near = np.linalg.norm(points - points[0], axis=1)
    at = np.argmin(np.abs(near - 10.0))
    assert np.mean(errors[:, 0] * errors[:, at]) / 0.01 == pytest.approx(np.exp(-1.0), abs=0.35)


def test_the_footprint_of_an_oblique_beam_leans() -> None:
    """On a plane the centroid is the axis; on a sphere lit at 45 degrees it lies beside it."""
    plane = trimesh.creation.box((100.0, 100.0, 2.0))
    way = np.array([[np.sqrt(0.5), 0.0, -np.sqrt(0.5)]])
    eye = np.array([[0.0, 0.0, 1.0]])
    axis, centroid, whole = footprint(plane, -50.0 * way, way, eye, 1.0)
    assert whole.all()
    np.testing.assert_allclose(centroid, axis, atol=1e-6)
    ball = trimesh.creation.icosphere(subdivisions=5, radius=18.0)
    target = np.array([[0.0, 0.0, 18.0]])
    axis, centroid, _ = footprint(ball, target - 50.0 * way, way, eye, 1.0)
    assert 0.01 < np.linalg.norm(centroid - axis) < 0.1
    missed = footprint(ball, target - 50.0 * way + [0.0, 17.9, 0.0], way, eye, 1.0)[2]
    assert not missed.any()
