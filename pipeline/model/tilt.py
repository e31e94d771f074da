"""Light that has not lost its direction: the first angular moment of the reflectance, at both ends by one law.

Light that enters obliquely is displaced along its way before it is diffuse, so more of it leaves ahead than behind: a
factor stands beside R_d,

    R(x_i, w_i; x_o, w_o) = F_t(w_i) F_t(w_o) / pi * R_d(x_i, x_o) * exp(s(r) (t_i + t_o) . e)

with r the distance, e the unit vector from x_i to x_o, and t the part along the surface of the refracted direction of
travel, |t| = sin(theta) / eta. A source displaced by a transport mean free path l has s = -l d ln R_d / dr; s itself is
measured, since near light follows another law than far light. Swapping the ends and turning both ways round changes
nothing: the law is reciprocal.

Samples are fitted with this factor. Light on an object is summed with its first order, 1 + s (t_i + t_o) . e, which is
linear in the directions: a light then acts by its flux and its flux times t alone, and the factor's mean under light
from all directions alike is 1, so R_d keeps its meaning (docs/decisions/0120).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hw.base.arrays import F64


@dataclass(frozen=True)
class TiltLaw:
    """distance: (K,) mm, ascending; slope: (K,) s there; linear in the logarithm of distance, constant beyond."""

    distance: F64
    slope: F64

    @staticmethod
    def basis(r: F64, distance: F64) -> F64:
        """(..., K) what each slope adds to s at distances r in mm."""
        at = np.log(np.maximum(r, 1e-3 * distance[0]))
        return np.stack([np.interp(at, np.log(distance), one) for one in np.eye(len(distance))], axis=-1)

    def __call__(self, r: F64) -> F64:
        """s at distances in mm."""
        at = np.log(np.maximum(r, 1e-3 * self.distance[0]))
        return np.asarray(np.interp(at, np.log(self.distance), self.slope))

    def factor(self, r: F64, tilt: F64) -> F64:
        """exp(s(r) tilt): light falls off exponentially, and so it does when it is displaced. tilt: (t_i + t_o) . e, of
        the shape of r.
        """
        return np.asarray(np.exp(self(r) * tilt))


def tilt_kernel(reflectance: F64, distance: F64, law: TiltLaw) -> F64:
    """R_d s(r) / r in mm^-3, 0 at r = 0; reflectance in mm^-2 and distance in mm, of one shape."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(distance > 0, reflectance * law(distance) / distance, 0.0)


def placed(flux: F64, points: F64) -> F64:
    """(8, N) what a `tilt_kernel` multiplies so that `gathered` has the sums of q R_d s e, with e = (x_o - x_i) / r:
    the products with x_o stand outside the sum over x_i. flux: (4, N) q and q t in W; points: (N, 3) x_i in mm
    """
    q, *along = flux
    return np.stack([*along, (np.stack(along, axis=1) * points).sum(axis=1), q, *(q * points.T)])


def gathered(product: F64, points: F64) -> F64:
    """(4, N) W/mm^2: what R_d's first order adds to the radiosity, and the radiosity's first moments.

    product: (8, N) `placed` times the kernel; points: (N, 3) x_o in mm
    """
    along, own, here, moved = np.split(product, [3, 4, 5])
    return np.concatenate([(along.T * points).sum(axis=1)[None] - own, here * points.T - moved])
