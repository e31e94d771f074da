"""The scan's own error from what a fit of silhouettes leaves: drawn errors of known size, and the fit's z-scores."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.calibrate.least_squares import Linearised, Prior
from pipeline.calibrate.scan_error import surface_error

RADIUS, SCALE = 18.0, 3.3  # mm, pixels per mm


def outlines() -> tuple[np.ndarray, np.ndarray]:
    """(K, 4) places on three great circles, and the (K, 5) derivative of the edges by shifts, size and turns."""
    around = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    c, s, none = RADIUS * np.cos(around), RADIUS * np.sin(around), np.zeros(120)
    place = np.concatenate([np.column_stack(x) for x in ((c, s, none), (c, none, s), (none, c, s))])
    columns = [np.ones(120), np.cos(around), np.sin(around), 2 * np.cos(2 * around), 2 * np.sin(2 * around)]
    return np.column_stack([place, np.full(360, SCALE)]), SCALE * np.tile(np.column_stack(columns), (3, 1))


def left(j: np.ndarray, rest: np.ndarray, weight: np.ndarray) -> Linearised:
    """A fit without a prior, and what it leaves."""
    unknowns = np.zeros(j.shape[1])
    return Linearised(unknowns, rest, j, weight, Prior(unknowns, np.diag(unknowns)))


@pytest.mark.parametrize("length_mm", [5.0, 10.0, 20.0])
def test_the_scans_error_and_what_it_does_are_known(length_mm: float) -> None:
    """Expected: .1 mm that is alike over a length that nobody tells is found, mostly with its length, although the fit
    takes half of it for motion; with white errors alone none is found. z-scores of 60 fits have a root mean square
    between .8 and 1.25.
    """
    rng = np.random.default_rng(0)
    place, j = outlines()
    apart = np.linalg.norm(place[:, None, :3] - place[None, :, :3], axis=2)
    root = np.linalg.cholesky(np.exp(-((apart / length_mm) ** 2)) + 1e-9 * np.eye(360))
    weight, inverse = np.full(360, 0.3**-2), np.linalg.inv(j.T @ j / 0.3**2)
    found, scores, white, alike = [], [], [], []
    for _ in range(60):
        noise = 0.02 * rng.standard_normal(360)
        error = 0.1 * SCALE * root @ rng.standard_normal(360) + noise
        for edges, sizes in ((error, found), (noise, white)):
            step = inverse @ (j.T @ (weight * edges))
            scan = surface_error(left(j, edges - j @ step, weight), np.ones(360), place)
            sizes.append(scan.size_mm)
            if edges is error:
                scores.append(step / np.sqrt(np.diag(inverse @ scan.push @ inverse)))
                alike.append(scan.alike_mm)
    assert abs(np.sqrt(np.mean(np.square(found))) - 0.1) < 0.01
    assert max(white) < 0.005
    assert np.median(alike) == length_mm
    assert 0.8 < np.sqrt(np.mean(np.square(scores))) < 1.25
    assert np.std(scores, axis=0).min() > 0.6


def test_what_is_hardly_known_has_a_wide_error() -> None:
    """One outline has 3 degrees of freedom: wide enough all the same (.6 to 1.25; without Student's factor 1.7)."""
    rng = np.random.default_rng(1)
    place, j = (x[:120] for x in outlines())
    apart = np.linalg.norm(place[:, None, :3] - place[None, :, :3], axis=2)
    root = np.linalg.cholesky(np.exp(-((apart / 10.0) ** 2)) + 1e-9 * np.eye(120))
    weight, inverse = np.full(120, 0.3**-2), np.linalg.inv(j.T @ j / 0.3**2)
    scores = []
    for _ in range(100):
        error = 0.1 * SCALE * root @ rng.standard_normal(120) + 0.02 * rng.standard_normal(120)
        step = inverse @ (j.T @ (weight * error))
        scan = surface_error(left(j, error - j @ step, weight), np.ones(120), place)
        if scan.size_mm > 0:
            scores.append(step / np.sqrt(np.diag(inverse @ scan.push @ inverse)))
    assert len(scores) > 90
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.25


@pytest.mark.parametrize("larger", [1 / 36, 30.0])
def test_edges_that_say_nothing_of_patches(larger: float, caplog: pytest.LogCaptureFixture) -> None:
    """No two edges of a crumb, or of few edges on a large object, are near and not adjacent: nothing, and a warning."""
    place, j = (x[:: 1 if larger < 1 else 6] for x in outlines())
    place[:, :3] *= larger
    ones = np.ones(len(place))
    scan = surface_error(left(j, 0.05 * ones, 0.3**-2 * ones), ones, place)
    assert scan.size_mm == scan.alike_mm == 0.0
    assert not scan.push.any()
    assert "apart" in caplog.text
