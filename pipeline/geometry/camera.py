"""Pinhole camera with OpenCV's five-parameter distortion, in the object frame or any other.

Conventions: the camera looks along +z of its own frame, x right, y down. Pixel (row r, column c) covers
[c, c+1) x [r, r+1) of the image plane, its centre is (c + 1/2, r + 1/2); OpenCV's principal point is ours minus 1/2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from hw.base.arrays import F64
from hw.base.errors import InputError
from pipeline.geometry.distortion import derivatives, distort
from pipeline.geometry.nominal_rig import CameraConfig

Row = tuple[float, float, float, float]
Pose = tuple[Row, Row, Row, Row]  # a (4, 4) transform in a file


def look_at(position: ArrayLike, aim: ArrayLike, up: ArrayLike = (0, 0, 1)) -> F64:
    """(4, 4) transform world -> device for a device at `position` with +z towards `aim`, x right, y down.

    A device that looks straight along `up` (within 1e-6 rad) takes +y as up instead, or +x where it looks along y.

    Raises: InputError where both are one point.
    """
    eye = np.asarray(position, float)
    forward = np.asarray(aim, float) - eye
    distance = np.linalg.norm(forward)
    if distance == 0:
        raise InputError("position and aim are one point", value=position, remedy="aim at another point")
    forward = forward / distance
    upward = np.asarray(up, float)
    right = np.cross(forward, upward)
    if np.linalg.norm(right) <= 1e-6 * np.linalg.norm(upward):
        right = np.cross(forward, [0.0, 1.0, 0.0] if abs(forward[1]) < 0.9 else [1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return pose


def turn(angle_rad: float) -> F64:
    """(4, 4) transform object -> world of a turntable at `angle_rad`, counter-clockwise from above."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def pose_rows(matrix: F64) -> Pose:
    """(4, 4) as a file's nested tuples."""
    rows: list[Row] = [(float(a), float(b), float(c), float(d)) for a, b, c, d in matrix]
    return rows[0], rows[1], rows[2], rows[3]


@dataclass(frozen=True)
class PinholeCamera:
    """focal, centre: (2,) pixels; distortion: (5,) k1 k2 p1 p2 k3; pose: (4, 4) frame -> camera."""

    width: int
    height: int
    focal: F64
    centre: F64
    distortion: F64
    pose: F64

    @classmethod
    def from_config(cls, config: CameraConfig) -> PinholeCamera:
        """The nominal camera in the world frame. Raises: InputError where it aims at its own place."""
        focal = config.focal_length_mm / (config.pixel_pitch_um * 1e-3)
        return cls(
            config.width,
            config.height,
            np.array([focal, focal]),
            np.array([config.width / 2, config.height / 2]),
            np.array(config.distortion, float),
            look_at(config.position_mm, config.aim_mm, config.up),
        )

    def seen_from(self, frame_to_here: F64) -> PinholeCamera:
        """The same camera in another frame, given the (4, 4) transform from that frame to this one."""
        return replace(self, pose=self.pose @ frame_to_here)

    @property
    def position(self) -> F64:
        """(3,) centre of projection in the frame."""
        return np.asarray(-self.pose[:3, :3].T @ self.pose[:3, 3])

    def distort(self, xy: F64) -> F64:
        """(N, 2) normalised coordinates -> distorted ones."""
        return distort(xy, self.distortion)

    def undistort(self, xy: F64) -> F64:
        """Inverse of `distort` by Newton's method; exact to 1e-12 where it is invertible, NaN where it is not."""
        if not self.distortion.any():
            return xy
        out = xy.copy()
        for _ in range(20):
            residual = self.distort(out) - xy
            if np.abs(residual).max(initial=0.0) < 1e-13:
                break
            along, across, down = derivatives(out[:, 0], out[:, 1], self.distortion)
            determinant, (x, y) = along * down - across**2, residual.T
            out[:, 0] -= (down * x - across * y) / determinant
            out[:, 1] -= (along * y - across * x) / determinant
        else:
            with np.errstate(over="ignore", invalid="ignore"):
                found = np.abs(self.distort(out) - xy).max(axis=1) < 1e-9
            out[~found] = np.nan
        return out

    def project(self, points: F64) -> tuple[F64, F64]:
        """(N, 3) points of the frame -> (N, 2) pixel coordinates (x, y) and (N,) depth along +z in mm.

        NaN for points far outside the picture that the distortion's polynomial would fold back into it.
        """
        local = points @ self.pose[:3, :3].T + self.pose[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = local[:, :2] / local[:, 2:]
        pixels = self.distort(xy) * self.focal + self.centre
        if any(self.distortion):
            outside = np.linalg.norm(xy, axis=1) > 1.1 * self._reach
            inside = ((pixels >= 0) & (pixels <= [self.width, self.height])).all(axis=1)
            pixels[outside & inside] = np.nan
        return pixels, local[:, 2]

    @cached_property
    def _reach(self) -> float:
        """Of the picture's farthest corner, as the tangent of its angle off the axis."""
        corners = np.array([[0, 0], [self.width, 0], [0, self.height], [self.width, self.height]], float)
        return float(np.linalg.norm(self.undistort((corners - self.centre) / self.focal), axis=1).max())

    def ahead(self, pixels: F64) -> F64:
        """(N, 2) pixel coordinates (x, y) -> (N, 3) directions in the camera's own frame, each with z = 1."""
        xy = self.undistort((np.asarray(pixels, float) - self.centre) / self.focal)
        return np.column_stack([xy, np.ones(len(xy))])

    def illumination(self, exponent: float = 4.0) -> F64:
        """(H, W) light on the pixels relative to the optical axis: the power of the cosine off the axis."""
        cosine = 1.0 / np.linalg.norm(self.ahead(self.pixel_centres()), axis=1)
        return np.asarray(cosine.reshape(self.height, self.width) ** exponent)

    def rays(self, pixels: F64) -> tuple[F64, F64]:
        """(N, 2) pixel coordinates (x, y) -> (N, 3) origins and unit directions in the frame."""
        local = self.ahead(pixels)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        directions = local @ self.pose[:3, :3]
        return np.broadcast_to(self.position, directions.shape).copy(), directions

    def pixel_centres(self, supersample: int = 1) -> F64:
        """(height * width * s^2, 2) sample positions, row by row, each pixel's s x s samples on the refined grid."""
        x = (np.arange(self.width * supersample) + 0.5) / supersample
        y = (np.arange(self.height * supersample) + 0.5) / supersample
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
