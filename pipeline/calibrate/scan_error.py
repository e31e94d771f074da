"""By how much a scan is off over whole patches, as the edges of its silhouettes show it, and what that does to poses.

A scanner errs alike over some millimetres; edges err each for itself. Both variances follow from two quadratic forms of
what a fit leaves: its squares, and its products between places that are near but not adjacent (Rao 1971, variance
components). The fit takes a part of the errors for motion; the forms' expectations take that into account.
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

log = logging.getLogger(__name__)

LENGTH_MM = 10.0  # over which a scanner errs alike, a Gaussian correlation (thesis 4.4)
NEAR_MM = 2.0  # places that are nearer share an edge's own error
MOST_EDGES = 1200
LEAST_FREEDOM = 2.2  # with fewer the patches' variance is hardly known; Student's factor there is wide enough for all


def surface_error(j: F64, rest: F64, weight: F64, length: F64, place: F64, inverse: F64) -> tuple[float, F64]:
    """The patches' error in mm, and the (P, P) covariance of the fit's gradient that it causes.

    j: (K, P), rest: (K,) pixels that the fit leaves, weight: (K,) 1/pixels^2, length: (K,) pixels of outline, place:
    (K, 4) object frame, mm, and pixels per mm, inverse: (P, P) of the fit's precision.

    An error that is itself estimated, with n degrees of freedom, leaves Student's distribution: n / (n - 2) as wide.
    Where no two edges are near but not adjacent, nothing is known of it: zeros, and a warning.
    """
    every = -(-len(rest) // MOST_EDGES)
    j, rest, length, place = j[::every], rest[::every], length[::every], place[::every]
    weight = weight[::every] * every
    apart = np.linalg.norm(place[:, None, :3] - place[None, :, :3], axis=2)
    alike = np.exp(-((apart / LENGTH_MM) ** 2)) * np.outer(place[:, 3], place[:, 3])
    taken = inverse @ (j * weight[:, None]).T  # (P, K)

    def left(covariance: F64) -> F64:
        """What is left of errors of a (K, K) covariance: (1 - j taken) covariance (1 - j taken)^T."""
        moved = j @ (taken @ covariance)
        return np.asarray(covariance - moved - moved.T + j @ (taken @ covariance @ taken.T) @ j.T)

    kinds = left(np.eye(len(rest))), left(alike)
    near = (apart > NEAR_MM) & (apart < LENGTH_MM)
    forms = np.diag(length), np.outer(length, length) * alike * near
    if not near.any():
        log.warning(
            "no two edges of the silhouettes lie %g to %g mm apart: they do not tell how far the scan is off over "
            "whole patches, and poses are stated without it",
            NEAR_MM,
            LENGTH_MM,
        )
        return 0.0, np.zeros_like(inverse)
    to_variance = np.linalg.inv([[float((form * kind).sum()) for kind in kinds] for form in forms])
    own, common = to_variance @ [float(rest @ form @ rest) for form in forms]
    common = max(common, 0.0)
    form = to_variance[1, 0] * forms[0] + to_variance[1, 1] * forms[1]
    spread = form @ (max(own, 0.0) * kinds[0] + common * kinds[1])
    freedom = common**2 / max(float((spread * spread.T).sum()), 1e-300)
    freedom = max(freedom, LEAST_FREEDOM)
    student = freedom / (freedom - 2.0)
    push = j.T @ (weight[:, None] * alike * weight) @ j
    return float(np.sqrt(common)), common * student * push
