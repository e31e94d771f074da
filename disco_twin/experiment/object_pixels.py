"""Which pixels of a held-out view show the object, and how obliquely: those that are scored, the rim apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from hw.base.arrays import F64, Bool
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.pixel_footprints import trace_pixels

SUPERSAMPLE = 4  # rays per pixel and axis
RIM_COSINE = 0.2  # pixels that see the surface more obliquely than this are scored apart


@dataclass(frozen=True)
class ObjectPixels:
    """Of a view of the object's own mesh, not of its scan.

    mask: (H, W) pixels that the object fills by at least a half; cosine: (H, W) between normal and direction to the
    camera, the mean over a pixel's rays that meet the object, each with the normal interpolated over its triangle; 0
    where none does
    """

    mask: Bool
    cosine: F64

    @classmethod
    def of(cls, mesh: trimesh.Trimesh, camera: PinholeCamera) -> ObjectPixels:
        """The object's pixels in a camera's view."""
        shape = camera.height, camera.width
        count, total = np.zeros(shape[0] * shape[1]), np.zeros(shape[0] * shape[1])
        for rays in trace_pixels(mesh, camera, SUPERSAMPLE):
            count += np.bincount(rays.pixel, minlength=len(count))
            total += np.bincount(rays.pixel, np.maximum(rays.cosine, 0.0), len(count))
        cosine = total / np.maximum(count, 1)
        return cls((count >= 0.5 * SUPERSAMPLE**2).reshape(shape), cosine.reshape(shape))

    @property
    def rim(self) -> Bool:
        """(H, W) the object's pixels of a cosine below `RIM_COSINE`, where the scan's outline decides."""
        return np.asarray(self.mask & (self.cosine < RIM_COSINE))

    @property
    def inner(self) -> Bool:
        """(H, W) the object's other pixels: the main figures are of these."""
        return np.asarray(self.mask & ~self.rim)
