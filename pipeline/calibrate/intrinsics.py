"""Focal length, principal point and radial distortion from chessboards in many poses (thesis 5.2.2, Bouguet 2003).

Corners by OpenCV, sharpened by a model of a corner; then one least-squares fit of all boards, in which the nominal lens
counts as one more measurement with its stated tolerance, so that what small images cannot tell stays near what the lens
was built to be. The covariance includes everything that the boards' unknown poses let slip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import special

from hw.base.arrays import F64
from hw.base.errors import DiscoError
from pipeline.calibrate.least_squares import Linearised, Prior, minimise
from pipeline.geometry.camera import PinholeCamera

# What a lens and its mount keep to, standard deviations: focal length (share), centre (share of the width), k1.
FOCAL_TOLERANCE, CENTRE_TOLERANCE, K1_TOLERANCE = 0.005, 0.008, 0.08
LENS = 4  # unknowns: focal length, centre x, y, k1
LEAST_BOARDS = 6
WINDOW = 4  # pixels around a corner that its position is fitted to
PARTS = 4  # of a pixel, per axis, that a corner's model is averaged over
PART_BLUR = 12**-0.5 / PARTS  # standard deviation of a part's own box, in pixels
LEAST_WIDTH = 0.02  # of a board's corners in the image, across as a share of along: else they lie on a line
OUTLIER = 4.0  # a board whose corners are off by this many times the median board's is not used


@dataclass(frozen=True)
class Intrinsics:
    """What was found. values: focal (px), centre x, y (px, ours: OpenCV's plus 1/2), k1; covariance: (4, 4).

    reprojection_px: root mean square distance of the corners; poses: per board used, (4, 4) target -> camera;
    used: indices of those boards
    """

    values: F64
    covariance: F64
    reprojection_px: float
    poses: tuple[F64, ...]
    used: tuple[int, ...]

    def lens(self, nominal: PinholeCamera) -> PinholeCamera:
        """The nominal camera with this lens."""
        distortion = nominal.distortion.copy()
        distortion[0] = self.values[3]
        return replace(nominal, focal=np.full(2, self.values[0]), centre=self.values[1:3], distortion=distortion)


def find_corners(image: NDArray[np.floating], board: F64) -> F64 | None:
    """(N, 2) pixel coordinates (x, y) of the board's (N, 3) inner corners, or None where not all of them are seen.

    x runs to the right and y down the board: the labelling is right-handed whichever side of the board is seen.
    """
    columns, rows = (len(np.unique(np.round(board[:, k], 6))) for k in (0, 1))
    top = float(np.percentile(image, 98))
    if not top > 0:
        return None
    grey = np.clip(image * (220.0 / top), 0, 255).astype(np.uint8)
    scale = 2 if min(grey.shape) < 300 else 1  # the detector wants squares of ten pixels and more
    large = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(large, (columns, rows), flags=flags)
    if not found:
        return None
    points = (corners.reshape(rows, columns, 2).astype(np.float64) + 0.5) / scale
    right, down = points[0, -1] - points[0, 0], points[-1, 0] - points[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0:
        points = points[:, ::-1]
    return refine_corners(image, points.reshape(-1, 2), board)


def refine_corners(image: NDArray[np.floating], points: F64, board: F64) -> F64:
    """(N, 2) corners moved to where a blurred corner of the board fits the pixels around them best.

    The model of a corner is a product of two edges, erf(d / sqrt(2) sigma) each, with the directions that the board's
    homography gives them, averaged over the parts of each pixel. Gauss-Newton in shift, contrast and level.
    """
    plane, points = board[:, :2], points.copy()
    homography, _ = cv2.findHomography(plane, points)
    ahead = np.column_stack([plane, np.ones(len(plane))]) @ homography.T
    local = (homography[:2, :2] - (ahead[:, :2] / ahead[:, 2:])[:, :, None] * homography[2, :2]) / ahead[
        :, 2, None, None
    ]
    to_board = np.linalg.inv(local)  # (N, 2, 2) mm of the board per pixel
    steepness = np.linalg.norm(to_board, axis=2)
    normal = to_board / steepness[:, :, None]  # (N, edge, 2) unit, across the two edges of a corner
    half_square = 0.45 * np.abs(plane - plane[0]).max() / (len(np.unique(np.round(plane[:, 0], 6))) - 1)
    offsets = np.stack(np.meshgrid(*(np.arange(-WINDOW, WINDOW + 1),) * 2), axis=-1).reshape(-1, 2)
    middles = (np.arange(PARTS) + 0.5) / PARTS - 0.5
    parts = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
    size, image = np.array(image.shape[::-1]), image / np.abs(image).max()
    for _ in range(5):
        pixel = np.floor(points).astype(int)[:, None] + offsets
        inside = ((pixel >= 0) & (pixel < size)).all(axis=2)
        pixel = np.clip(pixel, 0, size - 1)
        value = image[pixel[..., 1], pixel[..., 0]].astype(np.float64)
        across = np.einsum("nkd,nmd->nmk", normal, pixel + 0.5 - points[:, None])
        near = (inside & (np.abs(across * steepness[:, None]) < half_square).all(axis=2)).astype(np.float64)
        across = across[:, :, None] + np.einsum("nkd,pd->npk", normal, parts)[:, None]  # (N, M, parts, edge)
        edge, bell = special.erf(across / (PART_BLUR * np.sqrt(2))), np.exp(-0.5 * (across / PART_BLUR) ** 2)
        bell *= np.sqrt(2 / np.pi) / PART_BLUR
        moved = -np.einsum("nmk,nkd->nmd", (bell * edge[..., ::-1]).mean(axis=2), normal)
        plain = np.stack([edge.prod(axis=3).mean(axis=2), np.ones(near.shape)], axis=2) * near[..., None]
        contrast = _least_squares(plain, value)[:, 0]
        design = np.concatenate([contrast[:, None, None] * moved * near[..., None], plain], axis=2)
        points += np.clip(_least_squares(design, value)[:, :2], -0.5, 0.5)
    return points


def _least_squares(design: F64, values: F64) -> F64:
    """(N, k) solutions of N systems (M, k) x = (M,); damped a little, so that an empty one gives zero."""
    normal_form = np.einsum("nmi,nmj->nij", design, design)
    size = np.trace(normal_form, axis1=1, axis2=2)[:, None, None] * 1e-12 + 1e-300
    right = np.einsum("nmi,nm->ni", design, values)[..., None]
    return np.asarray(np.linalg.solve(normal_form + size * np.eye(design.shape[2]), right)[..., 0])


def fit_intrinsics(corners: Sequence[F64 | None], board: F64, nominal: PinholeCamera) -> Intrinsics:
    """The lens and all boards' poses together. corners: per image (N, 2) or None; board: (N, 3) mm.

    The covariance is taken from the boards' scatter where that is larger than the corners': corners of one board err
    together.

    Raises: DiscoError where fewer than `LEAST_BOARDS` boards were found, or the fit does not converge.
    """
    seen = {i: c for i, c in enumerate(corners) if c is not None}
    if len(seen) < LEAST_BOARDS:
        raise DiscoError(
            f"the chessboard was found in {len(seen)} images, {LEAST_BOARDS} are needed. "
            "Remedy: light it evenly, keep all of it in view"
        )
    start = np.array([nominal.focal.mean(), *nominal.centre, nominal.distortion[0]])
    tolerance = np.array([FOCAL_TOLERANCE * start[0], *(CENTRE_TOLERANCE * nominal.width,) * 2, K1_TOLERANCE])
    first = np.concatenate([start, *(_pose_of(c, board, start, nominal) for c in seen.values())])
    every = _Boards(list(seen.values()), board, nominal).fit(first, tolerance, start)
    rms = np.sqrt((every.residual.reshape(len(seen), -1) ** 2).mean(axis=1))
    good = np.flatnonzero(rms < OUTLIER * np.median(rms))
    used = np.array(list(seen))[good]
    again = np.concatenate([every.value[:LENS], every.value[LENS:].reshape(-1, 6)[good].ravel()])
    boards = _Boards([seen[i] for i in used], board, nominal)
    fit = boards.fit(again, tolerance, start)
    inverse = fit.covariance[:LENS, :LENS]
    prior = fit.prior.precision[:LENS, :LENS]
    of_board = np.repeat(np.arange(len(used)), 2 * len(board))
    meat = fit.scatter(of_board, LENS, about_mean=True)[:LENS, :LENS] + prior
    scale = np.sqrt(np.maximum(np.diag(inverse @ meat @ inverse) / np.diag(inverse), 1.0))
    return Intrinsics(
        fit.value[:LENS],
        inverse * np.outer(scale, scale),
        float(np.sqrt(2 * (fit.residual**2).mean())),
        tuple(_matrix(pose) for pose in fit.value[LENS:].reshape(-1, 6)),
        tuple(int(i) for i in used),
    )


@dataclass(frozen=True)
class _Boards:
    """Boards seen by one camera. The unknowns are the lens (`LENS`), then each board's rotation vector and shift."""

    corners: Sequence[F64]
    board: F64
    nominal: PinholeCamera

    def residual(self, x: F64) -> F64:
        """(K,) pixels, predicted less seen, board after board."""
        return np.concatenate([self._predicted(x, i)[0] - (c - 0.5).ravel() for i, c in enumerate(self.corners)])

    def jacobian(self, x: F64) -> F64:
        """(K, P), OpenCV's own."""
        rows = 2 * len(self.board)
        out = np.zeros((rows * len(self.corners), len(x)))
        for i in range(len(self.corners)):
            j, part = self._predicted(x, i)[1], out[i * rows : (i + 1) * rows]
            part[:, :LENS] = np.column_stack([j[:, 6] + j[:, 7], j[:, 8:11]])
            part[:, LENS + 6 * i : LENS + 6 * i + 6] = j[:, :6]
        return out

    def _predicted(self, x: F64, i: int) -> tuple[F64, F64]:
        pose = x[LENS + 6 * i : LENS + 6 * i + 6]
        points, j = cv2.projectPoints(self.board, pose[:3], pose[3:], *_matrices(x[:LENS], self.nominal))
        return points.ravel(), j

    def fit(self, x: F64, tolerance: F64, nominal: F64) -> Linearised:
        """From a start. The corners' own noise, which the lens's tolerance counts against, is what the fit leaves."""
        mean, sigma = np.zeros(len(x)), np.full(len(x), np.inf)
        mean[:LENS] = nominal
        for _ in range(2):
            rest = self.residual(x)
            noise = max(float(np.sqrt(rest @ rest / max(len(rest) - len(x), 1))), 1e-9)
            sigma[:LENS] = tolerance / noise
            found = minimise(self.residual, x, Prior.independent(mean, sigma), self.jacobian)
            found.ended.require("the lens's fit", "photograph the boards again, sharp and all of each in sight")
            x = found.value
        rest = self.residual(x)
        weight = np.full(len(rest), max(len(rest) - len(x), 1) / max(float(rest @ rest), 1e-18))
        sigma[:LENS] = tolerance
        return Linearised(x, rest, self.jacobian(x), weight, Prior.independent(mean, sigma))


def _matrices(lens: F64, nominal: PinholeCamera) -> tuple[F64, F64]:
    """OpenCV's camera matrix (its principal point is ours minus 1/2) and distortion."""
    f, cx, cy, k1 = lens
    return np.array([[f, 0, cx - 0.5], [0, f, cy - 0.5], [0, 0, 1.0]]), np.array([k1, *nominal.distortion[1:]])


def _pose_of(points: F64, board: F64, lens: F64, nominal: PinholeCamera) -> F64:
    """(6,) rotation vector and translation of a board. Raises: DiscoError where its corners make no plane."""
    matrix, distortion = _matrices(lens, nominal)
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) if np.isfinite(points).all() else np.zeros(2)
    ok = extent[1] > LEAST_WIDTH * extent[0]
    if ok:
        ok, rotation, shift = cv2.solvePnP(board, points - 0.5, matrix, distortion, flags=cv2.SOLVEPNP_IPPE)
    if not ok:
        raise DiscoError("a chessboard's pose cannot be found from its corners. Remedy: photograph the board again, "
                         "all of it in sight")  # fmt: skip
    return np.concatenate([rotation.ravel(), shift.ravel()]).astype(np.float64)


def board_pose(points: F64, board: F64, lens: PinholeCamera) -> F64:
    """(4, 4) target -> camera of one board seen by a calibrated camera."""
    values = np.array([lens.focal[0], *lens.centre, lens.distortion[0]])
    pose = _pose_of(points, board, values, lens)
    matrix, distortion = _matrices(values, lens)
    rotation, shift = cv2.solvePnPRefineLM(board, points - 0.5, matrix, distortion, pose[:3].copy(), pose[3:].copy())
    return _matrix(np.concatenate([rotation.ravel(), shift.ravel()]))


def _matrix(pose: F64) -> F64:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = cv2.Rodrigues(pose[:3])[0], pose[3:]
    return out
