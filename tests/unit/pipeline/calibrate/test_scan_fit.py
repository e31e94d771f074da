"""The scan fitted to silhouettes: known bumps, a perfect scan, kriging written out, frames and numbering."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from calibrate_twin import Silhouettes, experiment, silhouettes
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from disco_twin.object.scanner import geometry_error
from pipeline.calibrate.least_squares import Prior
from pipeline.calibrate.pose import PoseFit, fit_poses
from pipeline.calibrate.scan_fit import Evidence, alike
from pipeline.geometry.mesh import displaced

F64 = NDArray[np.float64]


def fitted(seen: Silhouettes, mesh: trimesh.Trimesh) -> PoseFit:
    return fit_poses(seen.images, mesh, seen.lenses, seen.angles)


def rms(values: F64) -> float:
    return float(np.sqrt((values**2).mean()))


@pytest.fixture(scope="module")
def stone() -> tuple[Silhouettes, trimesh.Trimesh, F64]:
    """Silhouettes of the quick scene's stone, a scan of it that errs as a scanner does, and (V,) by how much."""
    exact, seen = experiment().scan, silhouettes(4, experiment().object.mesh)
    error = geometry_error(np.asarray(exact.vertices), np.random.default_rng(3))
    return seen, displaced(exact, error), error


@pytest.fixture(scope="module")
def found(stone: tuple[Silhouettes, trimesh.Trimesh, F64]) -> PoseFit:
    return fitted(*stone[:2])


def test_kriging_is_what_it_is_written_out_as() -> None:
    """Rasmussen and Williams 2006, eqs. 2.25, 2.26 and 2.30, with the poses' part in the covariance."""
    rng, places = np.random.default_rng(0), 4
    points = 12 * rng.standard_normal((150, 3))
    basis, size, own = alike(points, 10.0), 0.1, 0.05
    hats = np.where(rng.random((60, 150)) < 0.03, rng.random((60, 150)), 0.0)
    jacobian, sigma = rng.standard_normal((60, places)), np.array([0.3, 0.1, 20.0, 0.01])
    measured, mean = rng.standard_normal(60), np.array([0.0, 0.1, 0.0, 0.02])
    weight = rng.uniform(0.2, 1.0, 60)
    still = Prior.independent(mean, sigma)
    evidence = Evidence(10.0, np.column_stack([jacobian, hats @ basis]), measured, weight, still)
    kernel = size**2 * np.exp(-(np.linalg.norm(points[:, None] - points, axis=2) ** 2) / 100.0)
    whole = hats @ kernel @ hats.T + jacobian @ np.diag(sigma**2) @ jacobian.T + np.diag(own**2 / weight)
    gain, rest = np.linalg.solve(whole, hats @ kernel).T, measured - jacobian @ mean
    fit = evidence.fit(size, own)
    assert np.abs(basis @ fit.step()[places:] - gain @ rest).max() < 0.03 * size
    variance = ((basis @ fit.covariance[places:, places:]) * basis).sum(axis=1)
    assert np.abs(variance - np.diag(kernel - gain @ hats @ kernel)).max() < 0.01 * size**2

    def likelihood(size: float, own: float) -> float:
        cov = (size / 0.1) ** 2 * hats @ kernel @ hats.T + jacobian @ np.diag(sigma**2) @ jacobian.T
        cov += np.diag(own**2 / weight)
        return float(-0.5 * (rest @ np.linalg.solve(cov, rest) + np.linalg.slogdet(cov)[1]))

    for other in ((0.2, 0.05), (0.1, 0.4), (0.0, 0.3)):
        change = evidence.log_likelihood(*other) - evidence.log_likelihood(size, own)
        assert change == pytest.approx(likelihood(*other) - likelihood(size, own), rel=0.01)


def test_a_scanners_error_is_found_where_silhouettes_pass(
    stone: tuple[Silhouettes, trimesh.Trimesh, F64], found: PoseFit
) -> None:
    """Expected: less than two thirds of .1 mm are left, but for what moves the whole stone; all of it is stated."""
    scan, mesh = found.scan, stone[1]
    normals, arms = mesh.vertex_normals, mesh.vertices - mesh.vertices.mean(axis=0)
    whole = np.column_stack([normals, np.cross(arms, normals), (arms * normals).sum(axis=1)])

    def shape(error: F64) -> F64:
        return np.asarray(error - whole @ np.linalg.lstsq(whole, error, rcond=None)[0])

    left = stone[2] + scan.displacement
    assert scan.because == ""
    assert rms(shape(left)) < 0.66 * rms(shape(stone[2]))
    assert rms(left) < rms(stone[2])
    assert 0.6 < rms(left / scan.error) < 1.4
    assert scan.alike_mm == 10.0
    assert 0.5 < scan.size_mm / 0.1 < 2.0
    assert scan.chi2_after < 1.2 < scan.chi2_before


def test_a_perfect_scan_is_left_as_it_is() -> None:
    seen = silhouettes(4, experiment().object.mesh)
    scan = fitted(seen, experiment().object.mesh).scan
    assert scan.because
    assert not scan.displacement.any()


def test_a_bump_on_a_balls_scan_is_taken_off() -> None:
    """A ball's scan has a bump of .25 mm on the outline of a view: two thirds and more of it go; elsewhere the rms is a
    tenth of it at most."""
    ball = trimesh.creation.icosphere(4, 16.0)
    seen = silhouettes(4, ball)
    sight = seen.truth[0].pose[:3, :3]
    top = 16.0 * sight.T @ np.array([0.0, -1.0, 0.0])
    bump = 0.25 * np.exp(-(((np.asarray(ball.vertices) - top) ** 2).sum(axis=1)) / 6.0**2)
    scan = fitted(seen, displaced(ball, bump)).scan
    left = bump + scan.displacement
    assert np.abs(left[bump > 0.2]).max() < 0.08
    assert rms(left[bump < 0.01]) < 0.025
    assert rms(left / scan.error) < 1.5


@pytest.mark.slow
def test_the_object_may_stand_turned_and_its_vertices_be_numbered_anew(
    stone: tuple[Silhouettes, trimesh.Trimesh, F64], found: PoseFit
) -> None:
    """The same images, a scan in a frame that is turned about the axis: the same displacement, vertex by vertex."""
    seen, scan, _ = stone
    motion, order = np.eye(4), np.random.default_rng(0).permutation(len(scan.vertices))
    motion[:3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.7]).as_matrix()
    number = np.argsort(order)
    turned = trimesh.Trimesh(scan.vertices[order] @ motion[:3, :3].T, number[scan.faces], process=False)
    lenses = [lens.seen_from(np.linalg.inv(motion)) for lens in seen.lenses]
    again = fitted(replace(seen, lenses=lenses), turned).scan
    assert rms(again.displacement[number] - found.scan.displacement) < 0.1 * rms(found.scan.error)
    assert rms(again.error[number] / found.scan.error - 1) < 0.1
