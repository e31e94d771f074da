"""Where a laser spot's peak lies in an image, and whether the camera sees it at all (thesis 5.1, 5.2.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

F64 = NDArray[np.float64]

HALF = 0.5  # of the peak: what lies above it around the peak is the spot
LARGEST = 5.0  # times the beam's cross-section: an oblique beam on a translucent surface, but not a glow
FAINTEST = 0.08  # of the camera's bright spots, per watt: what an edge of the object glows with is fainter


@dataclass(frozen=True)
class Peak:
    """pixel: (2,) x, y of the centroid of all above half the peak; value: its radiance; size: pixels above half."""

    pixel: F64
    value: float
    size: int
    at_border: bool


def find_peak(image: NDArray[np.floating]) -> Peak:
    """The brightest spot of an (H, W) radiance image; single bright pixels (noise) are no spot."""
    smooth = ndimage.median_filter(np.asarray(image, np.float64), 3, mode="nearest")
    top = np.unravel_index(int(smooth.argmax()), smooth.shape)
    value = float(smooth[top])
    labels, _ = ndimage.label(smooth > HALF * value)
    spot = labels == labels[top] if labels[top] else smooth >= value
    rows, columns = np.nonzero(spot)
    weight = np.maximum(np.asarray(image, np.float64)[rows, columns] - HALF * value, 0.0) + 1e-300
    pixel = np.array([(weight * (columns + 0.5)).sum(), (weight * (rows + 0.5)).sum()]) / weight.sum()
    last = np.array(image.shape) - 1
    at_border = bool(rows.min() == 0 or columns.min() == 0 or rows.max() == last[0] or columns.max() == last[1])
    return Peak(pixel, value, len(rows), at_border)


def brightness(peaks: Sequence[Peak], power: F64) -> float:
    """What spots in full view show per watt, 1/(mm^2 sr): the 90th percentile over the images of all cameras.

    Of all, because a camera behind the object sees no spot at all.
    """
    return float(np.percentile(np.array([p.value for p in peaks]) / power, 90)) if len(peaks) else 0.0


def seen(peaks: Sequence[Peak], power: F64, beam_px: float, bright: float) -> NDArray[np.bool_]:
    """(N,) whether images show the spots themselves, rather than what glows around a hidden one.

    power: (N,) W; beam_px: the beam's diameter in pixels; bright: `brightness`. A hidden spot's brightest place is
    faint, or wide, or both.
    """
    value = np.array([p.value for p in peaks]) / power
    size = np.array([p.size for p in peaks])
    small = size <= LARGEST * np.pi / 4 * max(beam_px, 2.0) ** 2
    inside = np.array([not p.at_border for p in peaks], bool)
    return np.asarray(small & inside & (value > FAINTEST * bright))
