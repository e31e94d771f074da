"""Closed rings of corners in a plane: what lies inside them, and where two of their sides meet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hw.base.arrays import F64, I64, Bool

TOUCH = 1e-6  # of the rings' extent: sides nearer than this meet


def sides(ring: F64) -> F64:
    """(N, 2) corners -> (N, 2, 2) sides, each from a corner to the next."""
    return np.stack([ring, np.roll(ring, -1, axis=0)], axis=1)


def inside(points: F64, rings: Sequence[F64]) -> Bool:
    """(M,) whether (M, 2) points lie inside: a line from there to the far right crosses an odd number of sides."""
    ends = np.concatenate([sides(ring) for ring in rings])
    (ax, ay), (bx, by) = ends[:, 0].T, ends[:, 1].T
    x, y = points[:, :1], points[:, 1:]
    with np.errstate(divide="ignore", invalid="ignore"):  # level sides are never straddled
        right = x < ax + (y - ay) / (by - ay) * (bx - ax)
    return np.asarray((((ay > y) != (by > y)) & right).sum(axis=1) % 2 == 1)


def distance_to_sides(points: F64, rings: Sequence[F64]) -> F64:
    """(M,) distance of (M, 2) points from the nearest side."""
    ends = np.concatenate([sides(ring) for ring in rings])
    return np.asarray(_to_segments(points, ends).min(axis=1))


def meeting(rings: Sequence[F64]) -> tuple[int, int, F64] | None:
    """Two sides that meet other than at the corner that joins them: the rings that they are of, and (2,) where."""
    ends = np.concatenate([sides(ring) for ring in rings])
    ring = np.repeat(np.arange(len(rings)), [len(r) for r in rings])
    following = np.concatenate([np.roll(np.flatnonzero(ring == r), -1) for r in range(len(rings))])
    tolerance = TOUCH * float(np.ptp(ends.reshape(-1, 2), axis=0).max())
    i, j = (np.asarray(k, np.int64) for k in np.triu_indices(len(ends), 1))
    crossed = (_side_of(ends, j, i) < 0) & (_side_of(ends, i, j) < 0)
    first, last = (_to_segments(ends[:, k], ends) <= tolerance for k in (0, 1))  # [corner's side, other side]
    # A side's first corner is the last one of the side before it: only there may the two meet.
    touched = (
        (first[i, j] & (following[j] != i)) | (first[j, i] & (following[i] != j))
        | (last[i, j] & (following[i] != j)) | (last[j, i] & (following[j] != i))
    )  # fmt: skip
    found = np.flatnonzero(crossed | touched)
    if not len(found):
        return None
    a, b = i[found[0]], j[found[0]]
    return int(ring[a]), int(ring[b]), np.asarray(ends[[a, b]].mean(axis=(0, 1)))


def _side_of(ends: F64, i: I64, j: I64) -> F64:
    """Negative where the ends of the sides j lie on different sides of the lines through the sides i."""
    along = ends[i, 1] - ends[i, 0]
    product = [along[:, 0] * off[:, 1] - along[:, 1] * off[:, 0] for off in (ends[j, k] - ends[i, 0] for k in (0, 1))]
    return np.asarray(product[0] * product[1])


def _to_segments(points: F64, ends: F64) -> F64:
    """(M, S) distances of (M, 2) points from (S, 2, 2) segments."""
    along = ends[:, 1] - ends[:, 0]
    off = points[:, None] - ends[:, 0]
    share = np.clip((off * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-300), 0, 1)
    return np.asarray(np.linalg.norm(off - share[..., None] * along, axis=2))
