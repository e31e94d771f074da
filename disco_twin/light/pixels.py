"""Walks that start at a camera's pixels: which pixels can see the object, and rays through them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from disco_twin.light.sampling import Rng
from disco_twin.light.sources import opaque3, weight_type
from hw.base.arrays import F64, I64
from pipeline.geometry.camera import PinholeCamera

NEWTON_STEPS = 8  # of the lens's inverse, for distortions that cover the picture (`covers_image`)


def candidate_pixels(camera: PinholeCamera, vertices: F64, faces: I64) -> I64:
    """(N,) numbers (row * width + column) of all pixels that any ray to the object falls into, and a few around them.

    The boxes of the projected triangles, which hold them whole; a pixel more on every side where the lens bends lines.
    """
    shape = camera.height, camera.width
    where, depth = camera.project(vertices)
    if not np.isfinite(where).all() or depth.min() <= 0:  # reaches behind the camera, or folds: spare nothing
        return np.arange(shape[0] * shape[1])
    margin = 1 if camera.distortion.any() else 0
    corners = np.floor(where[faces]).astype(np.int64)
    low = np.clip(corners.min(axis=1) - margin, 0, [camera.width, camera.height])
    high = np.clip(corners.max(axis=1) + margin + 1, 0, [camera.width, camera.height])
    steps = np.zeros((shape[0] + 1, shape[1] + 1), np.int64)  # corners of boxes, whose double sum counts them
    for x, y, sign in ((low, low, 1), (high, high, 1), (low, high, -1), (high, low, -1)):
        np.add.at(steps, (y[:, 1], x[:, 0]), sign)
    return np.flatnonzero(steps.cumsum(axis=0).cumsum(axis=1)[: shape[0], : shape[1]] > 0)


class PixelSource:
    """Rays through the pixels of a camera, uniform over each, one pixel a tag, with the weight 1: what a walk meets is
    then, in the mean, the pixel's radiance.

    pixels: (T,) numbers row * width + column.
    """

    scale = 1.0

    def __init__(self, camera: PinholeCamera, pixels: I64, lasers: int) -> None:
        self.pixels, self.width = mi.UInt32(pixels.astype(np.uint32)), camera.width
        self.position = opaque3(mi.Point3f, camera.position)
        self.rotation = [opaque3(mi.Vector3f, row) for row in camera.pose[:3, :3]]
        self.lens = [dr.opaque(mi.Float, float(v)) for v in (*camera.focal, *camera.centre, *camera.distortion)]
        self.bends, self.weight = bool(camera.distortion.any()), weight_type(lasers)

    def launch(self, rng: Rng, tag: Any, active: Any) -> tuple[Any, Any, Any]:
        pixel = dr.gather(mi.UInt32, self.pixels, tag, active)
        row = pixel // self.width
        fx, fy, cx, cy = self.lens[:4]
        x = (mi.Float(pixel - row * self.width) + rng.next() - cx) / fx
        y = (mi.Float(row) + rng.next() - cy) / fy
        if self.bends:
            x, y = self._undistorted(x, y)
        right, down, forward = self.rotation
        return mi.Point3f(self.position), dr.normalize(right * x + down * y + forward), self.weight(1.0)

    def _undistorted(self, u: Any, v: Any) -> tuple[Any, Any]:
        """Solve x radial + ... = u (pipeline/geometry/distortion.py) by Newton's method."""
        k1, k2, p1, p2, k3 = self.lens[4:]
        x, y = mi.Float(u), mi.Float(v)
        for _ in range(NEWTON_STEPS):
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
            du = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - u
            dv = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - v
            dxx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
            dxy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
            dyy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
            inverse = 1.0 / (dxx * dyy - dxy * dxy)
            x, y = x - (dyy * du - dxy * dv) * inverse, y - (dxx * dv - dxy * du) * inverse
        return x, y
