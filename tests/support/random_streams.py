"""Streams of random numbers."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from disco_twin.light.sampling import Rng

F64 = NDArray[np.float64]


N = 1 << 19


def streams(seed: int = 1, stream: int = 2, first: int = 0, n: int = N) -> Rng:
    return Rng.of(mi.UInt32(seed), mi.UInt32(stream), dr.arange(mi.UInt32, n) + first)


def azimuth(direction: F64, axis: F64) -> tuple[F64, F64]:
    """(N, 3) directions -> cosine to `axis` and azimuth about it as a share of the circle, in a frame of its own."""
    side = np.cross(axis, [0.0, 1.0, 0.1])
    side /= np.linalg.norm(side)
    up = np.cross(axis, side)
    return direction @ axis, np.arctan2(direction @ up, direction @ side) / (2 * math.pi) % 1.0
