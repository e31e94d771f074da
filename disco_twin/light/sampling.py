"""Random numbers and the samplers of the photon walk, as Dr.Jit functions.

All of them need an active Mitsuba variant (`disco_twin.light.backend.activate`). Every sampler has a density beside it
and a chi-squared test in tests/validation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

UNIFORM = 1.0 / (4.0 * math.pi)  # density per steradian of `uniform_sphere`


def mix32(v: Any) -> Any:
    """A bijective hash of 32-bit integers with low bias (constants found by C. Wellons's search, 2018)."""
    v = v ^ (v >> 16)
    v = v * mi.UInt32(0x7FEB352D)
    v = v ^ (v >> 15)
    v = v * mi.UInt32(0x846CA68B)
    return v ^ (v >> 16)


@dataclass
class Rng:
    """xoroshiro64* (Blackman and Vigna 2018), one stream per photon.

    A photon's stream depends on (seed, stream, index) alone, not on the lane that walks it: results are the same for
    every batch size, lane and thread count.
    """

    s0: Any
    s1: Any

    @staticmethod
    def of(seed: Any, stream: Any, index: Any) -> Rng:
        """The generator of photon `index` of `stream` (all UInt32)."""
        key = mix32(mix32(seed ^ mi.UInt32(0x9E3779B9)) ^ stream)
        s0 = mix32(key ^ mix32(index + mi.UInt32(0x3C6EF372)))
        s1 = mix32(mix32(index ^ mi.UInt32(0xDAA66D2B)) + key)
        return Rng(s0, s1 | mi.UInt32(1))

    def next(self) -> Any:
        """Uniform Float in [0, 1) with 23 bits."""
        return dr.reinterpret_array(mi.Float, (self._bits() >> 9) | mi.UInt32(0x3F800000)) - 1.0

    def fine(self) -> Any:
        """The same number with all of its 32 bits, as far as a Float holds them, in [0, 1]: for small chances. One of
        1e-8 would else happen as often as one of 1.2e-7.
        """
        return mi.Float(self._bits()) * 2.0**-32

    def _bits(self) -> Any:
        s0, s1 = self.s0, self.s1
        result = s0 * mi.UInt32(0x9E3779BB)
        s1 = s1 ^ s0
        self.s0 = ((s0 << 26) | (s0 >> 6)) ^ s1 ^ (s1 << 9)
        self.s1 = (s1 << 13) | (s1 >> 19)
        return result

    def next2(self) -> Any:
        """Two uniform numbers as a Point2f."""
        first = self.next()
        return mi.Point2f(first, self.next())


def exponential(rng: Rng) -> Any:
    """Exponentially distributed with mean 1."""
    return -dr.log(1.0 - rng.next())


def uniform_disc(rng: Rng) -> Any:
    """Uniform in the unit disc, Point2f."""
    radius = dr.sqrt(rng.next())
    s, c = dr.sincos(2.0 * math.pi * rng.next())
    return mi.Point2f(radius * c, radius * s)


def gaussian_disc(rng: Rng) -> Any:
    """Point2f with density exp(-2 r^2) * 2/pi: a Gaussian beam whose 1/e^2 radius is 1."""
    radius = dr.sqrt(0.5 * exponential(rng))
    s, c = dr.sincos(2.0 * math.pi * rng.next())
    return mi.Point2f(radius * c, radius * s)


def uniform_sphere(rng: Rng) -> Any:
    """Uniform direction, Vector3f."""
    z = 1.0 - 2.0 * rng.next()
    r = dr.safe_sqrt(1.0 - z * z)
    s, c = dr.sincos(2.0 * math.pi * rng.next())
    return mi.Vector3f(r * c, r * s, z)


def cosine_hemisphere(rng: Rng) -> Any:
    """Direction about +z with density cos / pi, Vector3f."""
    disc = uniform_disc(rng)
    return mi.Vector3f(disc.x, disc.y, dr.safe_sqrt(1.0 - dr.squared_norm(disc)))


def henyey_greenstein_pdf(cos_theta: Any, g: Any) -> Any:
    """Density per steradian of the phase function (Henyey and Greenstein 1941)."""
    denominator = 1.0 + g * g - 2.0 * g * cos_theta
    return (1.0 - g * g) / (4.0 * math.pi * denominator * dr.sqrt(denominator))


def henyey_greenstein(rng: Rng, direction: Any, g: Any) -> Any:
    """New direction of flight after a scattering event, given the old one; g = 0 is isotropic."""
    u = rng.next()
    t = (1.0 - g * g) / (1.0 - g + 2.0 * g * u)
    forward = (1.0 + g * g - t * t) / (2.0 * g)
    cos_theta = dr.clip(dr.select(dr.abs(g) < 1e-3, 1.0 - 2.0 * u, forward), -1.0, 1.0)
    sin_theta = dr.safe_sqrt(1.0 - cos_theta * cos_theta)
    s, c = dr.sincos(2.0 * math.pi * rng.next())
    frame = mi.Frame3f(direction)
    return frame.s * (sin_theta * c) + frame.t * (sin_theta * s) + frame.n * cos_theta


def von_mises_fisher_pdf(cos_theta: Any, kappa: Any) -> Any:
    """Density per steradian of a von Mises-Fisher lobe at cos_theta from its axis, stable for large kappa."""
    return kappa / (2.0 * math.pi * (1.0 - dr.exp(-2.0 * kappa))) * dr.exp(kappa * (cos_theta - 1.0))


def von_mises_fisher(rng: Rng, axis: Any, kappa: Any) -> Any:
    """Direction from a von Mises-Fisher lobe (Jakob 2012, numerically stable sampling)."""
    u = rng.next()
    # 1e-37 is a normal number: whether a thread flushes denormal ones to zero must not matter.
    cos_theta = 1.0 + dr.log(dr.maximum(u + (1.0 - u) * dr.exp(-2.0 * kappa), 1e-37)) / kappa
    cos_theta = dr.clip(cos_theta, -1.0, 1.0)
    sin_theta = dr.safe_sqrt(1.0 - cos_theta * cos_theta)
    s, c = dr.sincos(2.0 * math.pi * rng.next())
    return mi.Frame3f(axis).to_world(mi.Vector3f(sin_theta * c, sin_theta * s, cos_theta))


def hat_barycentrics(rng: Rng) -> Any:
    """Barycentrics (b0, b1, b2) with density proportional to b0, Dirichlet(2, 1, 1), as a Point3f."""
    e0 = exponential(rng) + exponential(rng)
    e1 = exponential(rng)
    e2 = exponential(rng)
    return mi.Point3f(e0, e1, e2) / (e0 + e1 + e2)
