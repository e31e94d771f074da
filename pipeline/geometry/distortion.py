"""Lens distortion, and whether it can be undone: OpenCV's k1 k2 p1 p2 k3 must be one-to-one over the whole image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hw.base.arrays import F64, Bool

DIRECTIONS, STEPS = 64, 400
WIDEST = 4.0  # tangent of the largest angle off the axis that is looked at, 76 degrees


def distort(xy: F64, distortion: Sequence[float] | F64) -> F64:
    """(..., 2) normalised coordinates -> distorted ones (OpenCV's rational model without the denominator)."""
    k1, k2, p1, p2, k3 = distortion
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([u, v], axis=-1)


def derivatives(x: F64, y: F64, distortion: Sequence[float] | F64) -> tuple[F64, F64, F64]:
    """Of `distort` at (...) x and y: du/dx, du/dy (which equals dv/dx) and dv/dy."""
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d radial / dx = slope * x
    along_x, along_y = slope * x * x + 2 * p1 * y + 6 * p2 * x, slope * y * y + 6 * p1 * y + 2 * p2 * x
    return radial + along_x, slope * x * y + 2 * p1 * x + 2 * p2 * y, radial + along_y


def covers_image(distortion: tuple[float, ...], half_width: float, half_height: float) -> bool:
    """Whether every point of the image belongs to exactly one direction on the way out from the axis.

    half_width, half_height: of the image, in focal lengths. In each of 64 directions a ray goes outwards in the
    undistorted plane until its image leaves the picture; on the way the determinant of the distortion's Jacobian must
    stay positive, otherwise the picture folds over (for p1 = p2 = 0: r (1 + k1 r^2 + k2 r^4 + k3 r^6) must rise).
    """
    angle = 2 * np.pi * np.arange(DIRECTIONS)[:, None] / DIRECTIONS
    # Finer near the axis, where the pictures of long lenses end: r rises with the square of the step.
    r = WIDEST * (np.arange(1, STEPS + 1) / STEPS) ** 2
    x, y = r * np.cos(angle), r * np.sin(angle)
    with np.errstate(over="ignore", invalid="ignore"):
        along, across, down = derivatives(x, y, distortion)
        determinant = along * down - across**2
        u, v = np.moveaxis(distort(np.stack([x, y], axis=-1), distortion), -1, 0)
        outside: Bool = (np.abs(u) > half_width) | (np.abs(v) > half_height)
    way_out: Bool = np.cumsum(outside, axis=1) - outside == 0  # with the first point outside
    one_to_one = (determinant > 0) & np.isfinite(determinant)
    return not any(distortion) or bool(outside.any(axis=1).all() and one_to_one[way_out].all())
