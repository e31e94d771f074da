"""Slips on purpose in the lens's calibration.

The stage's own score, or its z-score, sees each of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from calibrate_slips import F64, Patch, require_seen
from calibrate_twin import (
    boards,
    faulty_rig,
)

from pipeline.calibrate.intrinsics import find_corners, fit_intrinsics
from pipeline.geometry.camera import PinholeCamera

Corners = tuple[list[F64 | None], F64, PinholeCamera, PinholeCamera]


@pytest.fixture(scope="module")
def corners() -> Corners:
    rig = faulty_rig()
    targets, images, actual = boards(11, rig, 0)
    board = targets.corners()
    return [find_corners(image, board) for image in images], board, actual, PinholeCamera.from_config(rig.cameras[0])


def lens_scores(corners: Corners) -> tuple[float, float]:
    """Reprojection in pixels, and the largest z-score of focal length, centre and k1."""
    found_corners, board, actual, nominal = corners
    found = fit_intrinsics(found_corners, board, nominal)
    truth = np.array([actual.focal[0], *actual.centre, actual.distortion[0]])
    return found.reprojection_px, float(np.abs((found.values - truth) / np.sqrt(np.diag(found.covariance))).max())


def seen_as(change: Callable[[F64], F64]) -> Callable[[list[F64 | None]], list[F64 | None]]:
    return lambda found: [None if c is None else change(c) for c in found]


INTRINSICS = {
    "axes swapped": (5.0, 1, seen_as(lambda c: c[:, ::-1])),
    "rows for columns": (100.0, 0, seen_as(lambda c: c.reshape(6, 11, 2).transpose(1, 0, 2).reshape(-1, 2))),
    "half a pixel in every other row": (
        10.0,
        0,
        seen_as(lambda c: c + 0.5 * np.repeat(np.arange(6) % 2, 11)[:, None]),
    ),
}


@pytest.mark.parametrize("name", INTRINSICS)
def test_intrinsic_slips_show(name: str, corners: Corners) -> None:
    """Swapped axes look like the board seen from behind; the lens's centre then is off by many sigmas."""
    good = lens_scores(corners)
    assert good[0] < 0.15
    assert good[1] < 4
    factor, which, slip = INTRINSICS[name]
    least = (0.0, 1.0)[which]
    require_seen(lambda: lens_scores((slip(corners[0]), *corners[1:]))[which], max(good[which], least), factor)


def test_a_distortion_of_the_wrong_sign_shows(corners: Corners, monkeypatch: Patch) -> None:
    """Boards through a lens that bends ten times as much as the rig's; seen again through the lens that was found."""
    found_corners, board, actual, nominal = corners
    strong = replace(actual, distortion=np.array([-0.6, 0, 0, 0, 0]))
    bent = [
        None
        if c is None
        else strong.distort(actual.undistort((c - actual.centre) / actual.focal)) * actual.focal + actual.centre
        for c in found_corners
    ]
    found = fit_intrinsics(bent, board, replace(nominal, distortion=0.9 * strong.distortion))
    assert abs(found.values[3] + 0.6) < 4 * np.sqrt(found.covariance[3, 3])

    def again() -> float:
        lens = found.lens(nominal)
        away = [
            replace(lens, pose=place).project(board)[0] - bent[i]
            for place, i in zip(found.poses, found.used, strict=True)
        ]
        return float(np.sqrt((np.concatenate(away) ** 2).sum(axis=1).mean()))

    good, real = again(), PinholeCamera.distort
    assert good < 0.15
    monkeypatch.setattr(PinholeCamera, "distort", lambda self, xy: real(replace(self, distortion=-self.distortion), xy))
    require_seen(again, good, 5)
