"""Low-discrepancy sets of directions about axes."""

from __future__ import annotations

import numpy as np

from hw.base.arrays import F64, I64

_GOLDEN = 0.6180339887498949  # turns from one direction to the next: a Fibonacci lattice
_SHIFT = 0.7548776662466927  # turns from one point's lattice to the next point's, so that their errors average out


def lattice(index: I64, count: int) -> tuple[F64, F64]:
    """(N, count) numbers in 0..1 and azimuths in radians, for points numbered by (N,) `index`."""
    first = np.broadcast_to((np.arange(count) + 0.5) / count, (len(index), count))  # middles of strata
    return first, 2 * np.pi * ((np.arange(count) * _GOLDEN + index[:, None] * _SHIFT) % 1.0)


def cosine_directions(normals: F64, count: int, index: I64) -> F64:
    """(N, 3) unit normals -> (N, count, 3) unit directions of density cosine / pi; (N,) `index` turns the sets."""
    first, azimuth = lattice(index, count)
    return about(normals, np.sqrt(1 - first), azimuth)


def about(axes: F64, cosine: F64, azimuth: F64) -> F64:
    """(N, 3) unit axes, (N, K) cosines and azimuths about them -> (N, K, 3) unit directions (Duff et al. 2017)."""
    x, y, z = axes.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    u = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    v = np.stack([b, sign + y * y * a, -y], axis=1)
    sine = np.sqrt(np.maximum(0.0, 1 - cosine**2))
    return np.asarray(
        cosine[..., None] * axes[:, None]
        + (sine * np.cos(azimuth))[..., None] * u[:, None]
        + (sine * np.sin(azimuth))[..., None] * v[:, None]
    )
