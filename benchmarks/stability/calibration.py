"""Calibration: projectors from few, flat, far and false spots; lenses from boards that tell little; responses."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.stability.case import Ends, Family, relative
from hw.base.arrays import F64
from hw.record import Sensor
from pipeline.calibrate.intrinsics import find_corners, fit_intrinsics
from pipeline.calibrate.projector_fit import ProjectorFit, dlt, refine, true_spots
from pipeline.calibrate.response import fit_response
from pipeline.geometry.camera import PinholeCamera, look_at
from pipeline.geometry.projector import TwoMirrorProjector

FAMILY = Family("calibration")
SIGMA = 4.5
STEPS, FULL, APART = 4096, np.deg2rad(12.0), 12.0


def projector() -> TwoMirrorProjector:
    return TwoMirrorProjector(STEPS, np.full(2, FULL), APART, look_at((600.0, 0.0, 120.0), (0.0, 0.0, 0.0)))


def spots(thickness: float, count: int = 120, far: float = 0.0, seed: int = 0) -> tuple[F64, F64]:
    """(N, 3) points of an object 40 mm wide, `far` mm from the frame's origin along x, y and z, and (N, 2) steps."""
    rng = np.random.default_rng(seed)
    across = np.array([0.6, 0.1, 0.2]) / np.linalg.norm([0.6, 0.1, 0.2])
    points = rng.uniform(-20, 20, (count, 3))
    points -= np.outer(points @ across, across) * (1 - thickness)
    return points + far, moved(projector(), far).steps_to(points + far)


def moved(device: TwoMirrorProjector, far: float) -> TwoMirrorProjector:
    shift = np.eye(4)
    shift[:3, 3] = -far
    return device.seen_from(shift)


def reprojection(points: F64, steps: F64, matrix: F64) -> float:
    u, v, w = (np.column_stack([points, np.ones(len(points))]) @ matrix.T).T
    return float(np.abs(np.column_stack([u / w, v / w]) - steps).max())


def pinhole_steps(points: F64, far: float) -> F64:
    pose = moved(projector(), far).pose
    local = points @ pose[:3, :3].T + pose[:3, 3]
    return np.asarray(2048 + 20_000 * local[:, :2] / local[:, 2:])


def plain_dlt(points: F64, steps: F64) -> F64:
    """Without Hartley's normalisation."""
    x = np.column_stack([points, np.ones(len(points))])
    none = np.zeros_like(x)
    rows = np.concatenate([np.hstack([x, none, -steps[:, :1] * x]), np.hstack([none, x, -steps[:, 1:] * x])])
    return np.asarray(np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 4))


def projected(far: float, solve: object = dlt) -> float:
    points, _ = spots(1.0, far=far)
    steps = pinhole_steps(points, far)
    return reprojection(points, steps, solve(points, steps))  # type: ignore[operator]


for far in (0.0, 1e3, 1e6):
    FAMILY.case(
        f"a projection matrix, frame {far:g} mm off",
        "the spots' own steps to a hundredth",
        f"coordinates {far:g} mm",
        0.01,
        rivals={"DLT without normalisation": partial(projected, far, plain_dlt)},
    )(partial(projected, far))


def fitted(thickness: float, noise: float = 0.05, false: float = 0.0, far: float = 0.0, seed: int = 0) -> ProjectorFit:
    """Spots with noise (mm) and false ones, sorted and fitted as a capture's are."""
    rng = np.random.default_rng(seed + 1)
    points, steps = spots(thickness, far=far, seed=seed)
    seen = points + noise * rng.standard_normal(points.shape)
    wrong = rng.permutation(len(points))[: int(false * len(points))]
    seen[wrong] = points.mean(axis=0) + rng.uniform(-20, 20, (len(wrong), 3))
    good = true_spots(seen, steps, 40.0, rng)
    start, normals = moved(projector(), far), np.tile([1.0, 0.0, 0.0], (len(points), 1))
    return refine(start, seen[good], steps[good], normals[good], normals[good])


def off(fit: ProjectorFit, far: float = 0.0) -> float:
    """Largest miss in mm, over the stated error of the place that it is missed at, of beams through the object."""
    points, steps = spots(1.0, far=far, seed=9)
    origin, way = fit.projector.rays(steps)
    away = points - origin
    return float(np.linalg.norm(away - (away * way).sum(axis=1, keepdims=True) * way, axis=1).max())


def honest(fit: ProjectorFit) -> float:
    """Standard errors by which pose and full angles are off."""
    truth = projector()
    turned = Rotation.from_matrix(truth.pose[:3, :3] @ fit.projector.pose[:3, :3].T).as_rotvec()
    miss = np.concatenate(
        [turned, truth.pose[:3, 3] - fit.projector.pose[:3, 3], truth.full_angle_rad - fit.projector.full_angle_rad]
    )
    return float(np.abs(miss / np.sqrt(np.diag(fit.covariance))).max())


FAMILY.case("spots all over an object", "pose and angles within their stated errors", "40 mm thick", SIGMA, slow=True)(
    lambda: honest(fitted(1.0))
)
FAMILY.case("30 % false spots", "beams within .2 mm of the object's points", "36 of 120", 0.2, slow=True)(
    lambda: off(fitted(1.0, false=0.3))
)
FAMILY.case("70 % false spots", "beams within .2 mm, or refused", "84 of 120", 0.2, ends=Ends.EITHER, slow=True)(
    lambda: off(fitted(1.0, false=0.7))
)
FAMILY.case(
    "spots in a layer a thirtieth as thick as wide",
    "pose and angles within their stated errors",
    "1.3 of 40 mm",
    SIGMA,
    ends=Ends.EITHER,
    slow=True,
)(lambda: honest(fitted(0.033)))
FAMILY.case(
    "spots in a layer a hundredth as thick", "refused: the distance cannot be told", ".4 of 40 mm", ends=Ends.REFUSED
)(lambda: honest(fitted(0.01, noise=0.0)))
FAMILY.case("spots in a plane", "refused: the distance cannot be told", "0 mm", ends=Ends.REFUSED)(
    lambda: honest(fitted(0.0, noise=0.0))
)
FAMILY.case(
    "a frame a million mm off", "beams within .2 mm, or refused", "coordinates 1e6 mm", 0.2, ends=Ends.EITHER, slow=True
)(lambda: off(fitted(1.0, far=1e6), 1e6))
FAMILY.case("exact spots", "beams within a micrometre", "no noise", 1e-3)(lambda: off(fitted(1.0, noise=0.0)))


@FAMILY.case("spots that are not finite", "refused", "NaN", ends=Ends.REFUSED)
def not_finite() -> float:
    points, steps = spots(1.0)
    points[3] = np.nan
    return float(true_spots(points, steps, 40.0, np.random.default_rng(0)).sum())


@FAMILY.case("eleven spots", "refused: twelve are needed", "11", ends=Ends.REFUSED)
def few() -> float:
    points, steps = spots(1.0, count=11)
    return float(true_spots(points, steps, 40.0, np.random.default_rng(0)).sum())


# ---------------------------------------------------------------- lenses
BOARD = np.column_stack(
    [np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), axis=-1).reshape(-1, 2) * 4.0, np.zeros(54)]
)
NOMINAL = PinholeCamera(768, 496, np.full(2, 2273.0), np.array([384.0, 248.0]), np.zeros(5), np.eye(4))
TRUE = (2280.0, 388.0, 245.0, -0.1)


def boards(tilt: float, count: int = 12, noise: float = 0.03) -> list[F64 | None]:
    """Corners of boards about 450 mm away, tilted by up to `tilt` rad, through the true lens."""
    rng, out = np.random.default_rng(4), list[F64 | None]()
    matrix = np.array([[TRUE[0], 0, TRUE[1] - 0.5], [0, TRUE[0], TRUE[2] - 0.5], [0, 0, 1.0]])
    for _ in range(count):
        turn = np.append(rng.uniform(-tilt, tilt, 2), rng.uniform(-0.3, 0.3))
        shift = np.array([*rng.uniform(-20, 4, 2), 450.0 + rng.uniform(-30, 30)])
        points, _ = cv2.projectPoints(BOARD, turn, shift, matrix, np.array([TRUE[3], 0, 0, 0, 0]))
        out.append(points.reshape(-1, 2) + 0.5 + noise * rng.standard_normal((54, 2)))
    return out


def lens_off(corners: list[F64 | None]) -> float:
    """Standard errors by which focal length, centre and k1 are off."""
    found = fit_intrinsics(corners, BOARD, NOMINAL)
    return float(np.abs((found.values - TRUE) / np.sqrt(np.diag(found.covariance))).max())


FAMILY.case("a lens from boards in many poses", "within its stated errors", "tilted by .5 rad", SIGMA, slow=True)(
    lambda: lens_off(boards(0.5))
)
FAMILY.case(
    "a lens from boards square to its axis",
    "within stated errors: the focal length is the prior's",
    "tilted by 1e-4 rad",
    SIGMA,
)(lambda: lens_off(boards(1e-4)))
FAMILY.case("a lens from exact corners", "the true focal length to 1e-5", "no noise", 1e-5)(
    lambda: relative(fit_intrinsics(boards(0.5, noise=0.0), BOARD, NOMINAL).values[0], TRUE[0])
)
FAMILY.case(
    "a third of the boards are other boards", "within its stated errors", "4 of 12", SIGMA, ends=Ends.EITHER, slow=True
)(lambda: lens_off([*boards(0.5, 8), *(c[::-1] * [1.0, 1.3] for c in boards(0.5, 4) if c is not None)]))


@FAMILY.case("corners that all lie in one point", "refused", "no extent", ends=Ends.REFUSED)
def one_point() -> float:
    return lens_off([np.full((54, 2), 200.0) for _ in range(8)])


@FAMILY.case("corners that all lie on a line", "refused", "no extent across", ends=Ends.REFUSED)
def on_a_line() -> float:
    return lens_off([np.column_stack([np.linspace(100, 500, 54), np.full(54, 200.0)]) for _ in range(8)])


@FAMILY.case("corners that are not finite", "refused", "NaN", ends=Ends.REFUSED)
def corners_not_finite() -> float:
    return lens_off([np.full((54, 2), np.nan) for _ in range(8)])


def corners_found(image: NDArray[np.float32]) -> float:
    """Whether corners were found."""
    return float(find_corners(image, BOARD) is not None)


for name, image in (
    ("black", np.zeros((124, 192), np.float32)),
    ("not finite", np.full((124, 192), np.nan, np.float32)),
    ("of 1e30", np.full((124, 192), 1e30, np.float32)),
    ("of noise", np.random.default_rng(0).random((124, 192)).astype(np.float32)),
):
    FAMILY.case(f"a board's image that is {name}", "no corners", "124 x 192", slow=name == "of noise")(
        partial(corners_found, image)
    )


# ---------------------------------------------------------------- responses
CURVED = Sensor(1 / 30, 8, 12, 24.8, 25.0, 0.0, 64.0, (1e13,))


def response_off(
    gamma: float = 2.2, flicker: float = 0.0, level: float = 0.9, noise: float = 1.0, blank: bool = False
) -> float:
    """Largest error of the found response, in stated errors beyond half a per cent; a bracket of six images."""
    rng, span = np.random.default_rng(6), CURVED.saturation_dn - CURVED.offset_dn
    light = np.geomspace(0.002, 30, 6000) * level
    seconds, images = [2.0**-k for k in range(6)], []
    for k, time in enumerate(seconds):
        charge = np.minimum(light * time * (1 + flicker * (-1) ** k), 1.0) * 1e5
        share = np.clip((charge + noise * np.sqrt(charge + 625) * rng.standard_normal(charge.shape)) / 1e5, 0, 1)
        shown = np.zeros_like(share) if blank else share ** (1 / gamma)
        images.append(np.rint(CURVED.offset_dn + span * shown).clip(0, 4095).astype(np.uint16))
    found = fit_response(images, seconds, CURVED)
    exact = np.linspace(0, 1, len(found.exposure)) ** gamma
    return float((np.abs(found.exposure - exact) / (found.error + 5e-3)).max())


FAMILY.case(
    "a response from a bracket",
    "the true curve within its stated errors and half a per cent",
    "gamma 1.1",
    SIGMA,
    slow=True,
)(lambda: response_off(1.1))
FAMILY.case("a response from a dark bracket", "refused", "nothing but the offset", ends=Ends.REFUSED)(
    lambda: response_off(blank=True)
)
FAMILY.case(
    "a response under a lamp that flickers by 10 %", "refused: no still scene", "10 %", ends=Ends.REFUSED, slow=True
)(lambda: response_off(1.1, flicker=0.1))
FAMILY.case("a bracket of one image", "refused", "1", ends=Ends.REFUSED)(
    lambda: float(fit_response([np.zeros((4, 4), np.uint16)], [1.0], CURVED).chi2)
)
FAMILY.case("a bracket whose times are all alike", "refused", "no ratio", ends=Ends.REFUSED)(
    lambda: float(fit_response([np.full((40, 40), 64 + 100 * k, np.uint16) for k in range(3)], [1.0] * 3, CURVED).chi2)
)


@FAMILY.case("a bracket with a time of 0", "refused", "0 s", ends=Ends.REFUSED, slow=True)
def no_time() -> float:
    rng = np.random.default_rng(0)
    images = [rng.integers(64, 4095, (80, 80), dtype=np.uint16) for _ in range(3)]
    return float(fit_response(images, [1.0, 0.5, 0.0], replace(CURVED)).chi2)
