"""Where a laser spot's peak lies in an image, and whether the camera sees it at all (thesis 5.1, 5.2.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage

from hw.base.arrays import F64, Bool
from pipeline.geometry.mesh import RayMesh

ABOVE = 0.35  # of the peak: what lies above it around the peak is the spot
LARGEST = 5.0  # times the beam's cross-section: an oblique beam on a translucent surface, but not a glow
FAINTEST = 0.08  # of the camera's bright spots, per watt: what an edge of the object glows with is fainter


@dataclass(frozen=True)
class Peak:
    """pixel: (2,) x, y of the light's centroid; value: the peak's radiance; size: pixels of the spot."""

    pixel: F64
    value: float
    size: int
    at_border: bool


def find_peak(image: NDArray[np.floating]) -> Peak:
    """The brightest spot of an (H, W) radiance image; single bright pixels (noise) are no spot."""
    smooth = cv2.medianBlur(np.ascontiguousarray(image, np.float32), 3).astype(np.float64)
    top = np.unravel_index(int(smooth.argmax()), smooth.shape)
    value = float(smooth[top])
    labels, _ = ndimage.label(smooth > ABOVE * value)
    spot = labels == labels[top] if labels[top] else smooth >= value
    rows, columns = np.nonzero(spot)
    weight = np.maximum(np.asarray(image, np.float64)[rows, columns], 0.0) + 1e-300  # as light falls: see `footprint`
    pixel = np.array([(weight * (columns + 0.5)).sum(), (weight * (rows + 0.5)).sum()]) / weight.sum()
    last = np.array(image.shape) - 1
    at_border = bool(rows.min() == 0 or columns.min() == 0 or rows.max() == last[0] or columns.max() == last[1])
    return Peak(pixel, value, len(rows), at_border)


def brightness(peaks: Sequence[Peak], power: F64) -> float:
    """What spots in full view show per watt, 1/(mm^2 sr): the 90th percentile over the images of all cameras.

    Of all, because a camera behind the object sees no spot at all.
    """
    return float(np.percentile(np.array([p.value for p in peaks]) / power, 90)) if len(peaks) else 0.0


def seen(peaks: Sequence[Peak], power: F64, beam_px: float, bright: float) -> Bool:
    """(N,) whether images show the spots themselves, rather than what glows around a hidden one.

    power: (N,) W; beam_px: the beam's diameter in pixels; bright: `brightness`. A hidden spot's brightest place is
    faint, or wide, or both.
    """
    value = np.array([p.value for p in peaks]) / power
    size = np.array([p.size for p in peaks])
    small = size <= LARGEST * np.pi / 4 * max(beam_px, 2.0) ** 2
    inside = np.array([not p.at_border for p in peaks], bool)
    return np.asarray(small & inside & (value > FAINTEST * bright))


def footprint(mesh: trimesh.Trimesh, origins: F64, ways: F64, eyes: F64, radius: float) -> tuple[F64, F64, Bool]:
    """Where beams of a width meet a curved surface, as a camera weighs it: (N, 3) axis, (N, 3) centroid, (N,) all hit.

    origins, ways: (N, 3) beams' axes, mm; eyes: (N, 3) unit, towards the camera. On a surface seen or lit obliquely the
    light's centroid in the image is not where the axis meets the surface; the difference is made tangential.
    """
    rings = [(0.0, 0.0)] + [(r, a) for r, n in ((0.5, 6), (0.85, 12)) for a in 2 * np.pi * np.arange(n) / n]
    side = np.cross(ways, np.eye(3)[np.abs(ways).argmin(axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(ways, side)
    start = np.stack([origins + radius * r * (np.cos(a) * side + np.sin(a) * other) for r, a in rings], axis=1)
    surface, count = RayMesh.of(mesh), len(rings)
    hit = surface.first_hit(start.reshape(-1, 3), np.repeat(ways, count, axis=0))
    place = surface.points(hit.triangle, hit.barycentric).reshape(-1, count, 3)
    normal = surface.normals[hit.triangle].reshape(-1, count, 3)
    good = np.asarray((hit.triangle >= 0).reshape(-1, count).all(axis=1))
    weight = np.maximum(np.einsum("nkd,nd->nk", normal, eyes), 0.0) + 1e-12
    centroid = (weight[..., None] * place).sum(axis=1) / weight.sum(axis=1, keepdims=True)
    off, flat = centroid - place[:, 0], normal[:, 0]
    facing = np.maximum((eyes * flat).sum(axis=1, keepdims=True), 0.1)
    return place[:, 0], place[:, 0] + off - (off * flat).sum(axis=1, keepdims=True) / facing * eyes, good
