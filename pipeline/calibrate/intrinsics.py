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

from hw.base.errors import DiscoError
from pipeline.geometry.camera import PinholeCamera

F64 = NDArray[np.float64]

# What a lens and its mount keep to, standard deviations: focal length (share), centre (share of the width), k1.
FOCAL_TOLERANCE, CENTRE_TOLERANCE, K1_TOLERANCE = 0.005, 0.008, 0.08
LEAST_BOARDS = 6
WINDOW = 4  # pixels around a corner that its position is fitted to
PARTS = 4  # of a pixel, per axis, that a corner's model is averaged over
PART_BLUR = 12**-0.5 / PARTS  # standard deviation of a part's own box, in pixels
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
    """Gauss-Newton over the lens and all boards' poses. corners: per image (N, 2) or None; board: (N, 3) mm."""
    used = [i for i, c in enumerate(corners) if c is not None]
    if len(used) < LEAST_BOARDS:
        raise DiscoError(
            f"the chessboard was found in {len(used)} images, {LEAST_BOARDS} are needed. "
            "Remedy: light it evenly, keep all of it in view"
        )
    seen = {i: c for i, c in enumerate(corners) if c is not None}
    start = np.array([nominal.focal.mean(), *nominal.centre, nominal.distortion[0]])
    prior = np.array([FOCAL_TOLERANCE * start[0], *(CENTRE_TOLERANCE * nominal.width,) * 2, K1_TOLERANCE])
    lens = start.copy()
    poses = {i: _pose_of(seen[i], board, lens, nominal) for i in used}
    for round_ in range(12):
        if round_ == 6:
            rms = {i: float(np.sqrt((_residual(seen[i], board, lens, poses[i], nominal) ** 2).mean())) for i in used}
            limit = OUTLIER * float(np.median(list(rms.values())))
            used = [i for i in used if rms[i] < limit]
        step, inverse, blocks = _normal_step(used, seen, board, lens, poses, nominal, start, prior)
        lens = lens + step
        for i in used:
            gain, back = blocks[i]
            poses[i] = poses[i] + gain - back @ step
    squared = np.concatenate([_residual(seen[i], board, lens, poses[i], nominal) for i in used]) ** 2
    return Intrinsics(
        lens,
        inverse,
        float(np.sqrt(2 * squared.mean())),
        tuple(_matrix(poses[i]) for i in used),
        tuple(used),
    )


def _matrices(lens: F64, nominal: PinholeCamera) -> tuple[F64, F64]:
    """OpenCV's camera matrix (its principal point is ours minus 1/2) and distortion."""
    f, cx, cy, k1 = lens
    return np.array([[f, 0, cx - 0.5], [0, f, cy - 0.5], [0, 0, 1.0]]), np.array([k1, *nominal.distortion[1:]])


def _pose_of(points: F64, board: F64, lens: F64, nominal: PinholeCamera) -> F64:
    """(6,) rotation vector and translation of a board."""
    matrix, distortion = _matrices(lens, nominal)
    ok, rotation, shift = cv2.solvePnP(board, points - 0.5, matrix, distortion, flags=cv2.SOLVEPNP_IPPE)
    if not ok:
        raise DiscoError("a chessboard's pose cannot be found from its corners")
    return np.concatenate([rotation.ravel(), shift.ravel()]).astype(np.float64)


def _residual(points: F64, board: F64, lens: F64, pose: F64, nominal: PinholeCamera) -> F64:
    predicted, _ = cv2.projectPoints(board, pose[:3], pose[3:], *_matrices(lens, nominal))
    return np.asarray(((points - 0.5) - predicted.reshape(-1, 2)).ravel())


def _normal_step(
    used: Sequence[int],
    seen: dict[int, F64],
    board: F64,
    lens: F64,
    poses: dict[int, F64],
    nominal: PinholeCamera,
    start: F64,
    prior: F64,
) -> tuple[F64, F64, dict[int, tuple[F64, F64]]]:
    """One Gauss-Newton step with the poses eliminated (Schur complement).

    Returns the lens's step, its covariance, and per board (own step, how it follows the lens's). Corners of one board
    err together: the covariance is taken from the boards' scatter (sandwich estimator) where that is larger.
    """
    hessian, gradient = np.zeros((4, 4)), np.zeros(4)
    blocks, scores, total, freedom = {}, [], 0.0, 0
    matrix, distortion = _matrices(lens, nominal)
    for i in used:
        _, j = cv2.projectPoints(board, poses[i][:3], poses[i][3:], matrix, distortion)
        own, shared = j[:, :6], np.column_stack([j[:, 6] + j[:, 7], j[:, 8], j[:, 9], j[:, 10]])
        residual = _residual(seen[i], board, lens, poses[i], nominal)
        solve = np.linalg.pinv(own)
        gain, back = solve @ residual, solve @ shared
        free = shared - own @ back
        rest = residual - own @ gain
        blocks[i] = gain, back
        hessian += free.T @ free
        score = free.T @ rest
        scores.append(score)
        gradient += score
        total, freedom = total + rest @ rest, freedom + len(rest) - 6
    variance = total / max(freedom - 4, 1)
    precise = hessian / variance + np.diag(prior**-2)
    inverse = np.linalg.inv(precise)
    step = inverse @ (gradient / variance + (start - lens) / prior**2)
    spread = np.array(scores) - np.mean(scores, axis=0)
    meat = spread.T @ spread / variance**2 * len(used) / max(len(used) - 4, 1) + np.diag(prior**-2)
    sandwich = inverse @ meat @ inverse
    scale = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(inverse), 1.0))
    return step, inverse * np.outer(scale, scale), blocks


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
