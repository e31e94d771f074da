"""Lens distortion that can be undone: OpenCV's k1 k2 p1 p2 k3 must be one-to-one over the whole image."""

from __future__ import annotations

import math

DIRECTIONS, STEPS = 64, 400
WIDEST = 4.0  # tangent of the largest angle off the axis that is looked at, 76 degrees


def covers_image(distortion: tuple[float, ...], half_width: float, half_height: float) -> bool:
    """Whether every point of the image belongs to exactly one direction on the way out from the axis.

    half_width, half_height: of the image, in focal lengths. In each of 64 directions a ray goes outwards in the
    undistorted plane until its image leaves the picture; on the way the determinant of the distortion's Jacobian must
    stay positive, otherwise the picture folds over (for p1 = p2 = 0: r (1 + k1 r^2 + k2 r^4 + k3 r^6) must rise).
    """
    if not any(distortion):
        return True
    for i in range(DIRECTIONS):
        x, y = math.cos(2 * math.pi * i / DIRECTIONS), math.sin(2 * math.pi * i / DIRECTIONS)
        for step in range(1, STEPS + 1):
            # Finer near the axis, where the pictures of long lenses end: r rises with the square of the step.
            r = WIDEST * (step / STEPS) ** 2
            u, v, determinant = _mapped(r * x, r * y, distortion)
            if determinant <= 0 or not math.isfinite(determinant):
                return False
            if abs(u) > half_width or abs(v) > half_height:
                break
        else:
            return False
    return True


def _mapped(x: float, y: float, distortion: tuple[float, ...]) -> tuple[float, float, float]:
    """Distorted (u, v) of an undistorted point, and the determinant of d(u, v) / d(x, y)."""
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d radial / dx = slope * x
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    ux = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    uy = slope * x * y + 2 * p1 * x + 2 * p2 * y
    vy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return u, v, ux * vy - uy * uy
