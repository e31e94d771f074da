"""By how much a scan is off over whole patches, as the edges of its silhouettes show it, and what that does to poses.

A scanner errs alike over some millimetres; edges err each for itself. Both variances follow from two quadratic forms of
what a fit leaves: its squares, and its products between places that are near but not adjacent (Rao 1971, variance
components). The length over which it errs alike follows from the likelihood. The fit takes a part of the errors for
motion; the forms' expectations take that into account.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from hw.base.arrays import F64, I64
from pipeline.calibrate.least_squares import Linearised

log = logging.getLogger(__name__)

LENGTHS_MM = 5.0, 10.0, 20.0  # over which a scanner may err alike, a Gaussian correlation; the likeliest counts
FACTORS = 4.0 ** np.arange(-2, 4)  # of the patches' variance, tried for the likelihood of a length
NEAR_MM = 2.0  # places that are nearer share an edge's own error
MOST_EDGES = 1200
LEAST_FREEDOM = 3.0  # with fewer Student's factor grows without bound; three times the variance was enough for 2 to 3


@dataclass(frozen=True)
class SurfaceError:
    """size_mm: by how much the scan is off; alike_mm: over which length it is so alike, 0 where nothing is known;
    push: (P, P) covariance of the fit's gradient that it causes.
    """

    size_mm: float
    alike_mm: float
    push: F64


def surface_error(fit: Linearised, length: F64, place: F64) -> SurfaceError:
    """The patches' error.

    fit: K residuals in pixels, length: (K,) pixels of outline, place: (K, 4) object frame, mm, and pixels per mm.

    An error that is itself estimated, with n degrees of freedom, leaves Student's distribution: n / (n - 2) as wide.
    Where no two edges are near but not adjacent, nothing is known of it: zeros, and a warning.
    """
    every, inverse = -(-len(place) // MOST_EDGES), fit.covariance
    j, rest, length, place = fit.jacobian[::every], fit.residual[::every], length[::every], place[::every]
    weight = fit.weight[::every] * every
    apart = np.linalg.norm(place[:, None, :3] - place[None, :, :3], axis=2)
    taken = inverse @ (j * weight[:, None]).T  # (P, K)

    def left(covariance: F64) -> F64:
        """What is left of errors of a (K, K) covariance: (1 - j taken) covariance (1 - j taken)^T."""
        moved = j @ (taken @ covariance)
        return np.asarray(covariance - moved - moved.T + j @ (taken @ covariance @ taken.T) @ j.T)

    white, best = left(np.eye(len(rest))), None
    for millimetres in LENGTHS_MM:
        alike = np.exp(-((apart / millimetres) ** 2)) * np.outer(place[:, 3], place[:, 3])
        near = (apart > NEAR_MM) & (apart < millimetres)
        if near.any():
            forms = np.diag(length), np.outer(length, length) * alike * near
            found = _Patches.of(rest, (white, left(alike)), forms, alike, millimetres, _thinned(apart))
            best = found if best is None or found.likelihood > best.likelihood else best
    if best is None:
        log.warning(
            "no two edges of the silhouettes lie %g to %g mm apart: they do not show how far the scan is off over "
            "whole patches, and poses are stated without it",
            NEAR_MM,
            LENGTHS_MM[-1],
        )
        return SurfaceError(0.0, 0.0, np.zeros_like(inverse))
    push = j.T @ (weight[:, None] * best.alike * weight) @ j
    return SurfaceError(float(np.sqrt(best.variance)), best.alike_mm, best.variance * best.student * push)


@dataclass(frozen=True)
class _Patches:
    """Errors that are alike over one length: variance in mm^2, Student's factor of it, (K, K) alike in pixels per mm
    squared, that length in mm, and the logarithm of how likely what is left is with them.
    """

    variance: float
    student: float
    alike: F64
    alike_mm: float
    likelihood: float

    @classmethod
    def of(
        cls, rest: F64, kinds: tuple[F64, F64], forms: tuple[F64, F64], alike: F64, alike_mm: float,
        some: I64,
    ) -> _Patches:  # fmt: skip
        """rest: (K,) pixels; kinds: (K, K) what is left of both errors; forms: (K, K); some: (S,) places that share no
        edge's own error, for the likelihood.
        """
        to_variance = np.linalg.inv([[float((form * kind).sum()) for kind in kinds] for form in forms])
        own, common = to_variance @ [float(rest @ form @ rest) for form in forms]
        own, common = max(own, 1e-3 * float(rest @ rest) / len(rest), 1e-12), max(common, 0.0)
        both = own * kinds[0] + common * kinds[1]
        spread = (to_variance[1, 0] * forms[0] + to_variance[1, 1] * forms[1]) @ both
        freedom = max(common**2 / max(float((spread * spread.T).sum()), 1e-300), LEAST_FREEDOM)
        likelihood = max(
            _likelihood(rest[some], kinds[0][np.ix_(some, some)] * own + kinds[1][np.ix_(some, some)] * factor * common)
            for factor in FACTORS
        )
        return cls(common, freedom / (freedom - 2.0), alike, alike_mm, likelihood)


def _likelihood(rest: F64, covariance: F64) -> float:
    """Logarithm, of (S,) normal errors whose (S, S) covariance is known but for its scale, at the likeliest scale."""
    whole = covariance + 1e-3 * np.diag(covariance).mean() * np.eye(
        len(rest)
    )  # a fit leaves fewer freedoms than places
    scale = float(rest @ np.linalg.solve(whole, rest)) / len(rest)
    return -0.5 * float(np.linalg.slogdet(whole)[1] + len(rest) * np.log(max(scale, 1e-300)))


def _thinned(apart: F64) -> I64:
    """(S,) of the places, none nearer than NEAR_MM to another; apart: (K, K) mm."""
    free, kept = np.ones(len(apart), bool), []
    for k in range(len(apart)):
        if free[k]:
            kept.append(k)
            free &= apart[k] > NEAR_MM
    return np.array(kept, np.int64)
