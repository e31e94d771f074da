"""A walk of its own through nested spheres and boxes with smooth walls: float64 NumPy, analytic surfaces, no meshes.

It shares no line with the photon walk: it tracks to the nearest surface of the region that it is in, without null
collisions, distance fields or lobes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
FAINT = 0.05  # power below which Russian roulette decides


@dataclass(frozen=True)
class Ball:
    """A sphere."""

    centre: Sequence[float]
    radius: float

    def far(self, p: F64, d: F64, within: bool) -> F64:
        """(N,) way to the surface from inside, or from outside (infinite where it is missed)."""
        offset = p - np.asarray(self.centre)
        b, c = (offset * d).sum(axis=1), (offset**2).sum(axis=1) - self.radius**2
        root = np.sqrt(np.maximum(b * b - c, 0))
        if within:
            return np.asarray(np.maximum(root - b, 0))
        return np.where((b * b > c) & (b < 0), np.maximum(-b - root, 0), np.inf)

    def normal(self, p: F64) -> F64:
        return np.asarray((p - np.asarray(self.centre)) / self.radius)


@dataclass(frozen=True)
class Brick:
    """An axis-parallel box."""

    low: Sequence[float]
    high: Sequence[float]

    def far(self, p: F64, d: F64, within: bool) -> F64:
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (np.asarray(self.low) - p) / d, (np.asarray(self.high) - p) / d
        near, far = np.fmax.reduce(np.fmin(a, b), axis=1), np.fmin.reduce(np.fmax(a, b), axis=1)
        if within:
            return np.asarray(np.maximum(far, 0))
        # From a point on the surface that flies away, near is about 0 and so is far.
        return np.where((near < far) & (far > 1e-9), np.maximum(near, 0), np.inf)

    def normal(self, p: F64) -> F64:
        middle, half = np.add(self.low, self.high) / 2, np.subtract(self.high, self.low) / 2
        side = (p - middle) / half
        axis = np.abs(side).argmax(axis=1)
        out = np.zeros_like(p)
        out[np.arange(len(p)), axis] = np.sign(side[np.arange(len(p)), axis])
        return out


@dataclass(frozen=True)
class Region:
    """What a surface holds; albedo one a wavelength; around: index of the region around it, -1 the air."""

    shape: Ball | Brick
    around: int
    eta: float
    sigma_t: float
    albedo: Sequence[float]
    g: float = 0.0


def walk(regions: Sequence[Region], p: F64, d: F64, seed: int) -> tuple[F64, F64]:
    """(N, 3) places and (N, L) power with which light that starts at p (N, 3) in the air leaves region 0 at last; no
    power for what never entered, or was absorbed. The objects are convex: what leaves does not come back.
    """
    random = np.random.default_rng(seed)
    count, lasers = len(p), len(regions[0].albedo)
    p, d = p.copy(), d / np.linalg.norm(d, axis=1, keepdims=True)
    where, power = np.full(count, -1), np.ones((count, lasers))
    entered, alive = np.zeros(count, bool), np.ones(count, bool)
    out, left = np.zeros((count, 3)), np.zeros((count, lasers))
    while alive.any():
        for k in range(-1, len(regions)):
            own = np.flatnonzero(alive & (where == k))
            if not len(own):
                continue
            if k < 0 and entered[own].any():
                gone = own[entered[own]]
                out[gone], left[gone], alive[gone] = p[gone], power[gone], False
                own = own[~entered[own]]
            inner = [i for i, r in enumerate(regions) if r.around == k]
            ways = [regions[k].shape.far(p[own], d[own], True)] if k >= 0 else []
            ways += [regions[i].shape.far(p[own], d[own], False) for i in inner]
            met = ([k] if k >= 0 else []) + inner
            way = np.stack(ways, axis=1)
            which, way = way.argmin(axis=1), way.min(axis=1)
            sigma_t = regions[k].sigma_t if k >= 0 else 0.0
            flight = random.exponential(size=len(own)) / sigma_t if sigma_t else np.full(len(own), np.inf)
            alive[own[np.isinf(np.minimum(way, flight))]] = False
            hits = flight < way
            _scatter(regions[k], own[hits], flight[hits], p, d, power, alive, random)
            for i, surface in enumerate(met):
                crossing = ~hits & (which == i) & np.isfinite(way)
                _cross(regions, k, surface, own[crossing], way[crossing], p, d, where, entered, random)
    return out, left


def _scatter(
    region: Region, own: NDArray[np.int64], flight: F64, p: F64, d: F64, power: F64, alive: NDArray[np.bool_],
    random: np.random.Generator,
) -> None:  # fmt: skip
    if not len(own):
        return
    p[own] += d[own] * flight[:, None]
    power[own] *= region.albedo
    strongest = power[own].max(axis=1)
    faint = strongest < FAINT
    dies = faint & (random.random(len(own)) > strongest / FAINT)
    alive[own[dies]] = False
    power[own[faint & ~dies]] *= (FAINT / strongest[faint & ~dies])[:, None]
    u, g = random.random(len(own)), region.g
    cosine = 2 * u - 1 if g == 0 else (1 + g * g - ((1 - g * g) / (1 - g + 2 * g * u)) ** 2) / (2 * g)
    sine, turn = np.sqrt(np.maximum(1 - cosine**2, 0)), 2 * np.pi * random.random(len(own))
    along = d[own]
    other = np.where(np.abs(along[:, :1]) < 0.6, [[1.0, 0, 0]], [[0, 1.0, 0]])
    s = np.cross(along, other)
    s /= np.linalg.norm(s, axis=1, keepdims=True)
    t = np.cross(along, s)
    d[own] = along * cosine[:, None] + (s * np.cos(turn)[:, None] + t * np.sin(turn)[:, None]) * sine[:, None]


def _cross(
    regions: Sequence[Region], k: int, surface: int, own: NDArray[np.int64], way: F64, p: F64, d: F64,
    where: NDArray[np.int64], entered: NDArray[np.bool_], random: np.random.Generator,
) -> None:  # fmt: skip
    if not len(own):
        return
    p[own] += d[own] * way[:, None]
    normal = regions[surface].shape.normal(p[own])
    beyond = regions[k].around if surface == k else surface
    one, two = (regions[i].eta if i >= 0 else 1.0 for i in (k, beyond))
    normal *= -np.sign((normal * d[own]).sum(axis=1))[:, None]  # against the flight
    ci = -(normal * d[own]).sum(axis=1)
    ratio = one / two
    sine2 = ratio**2 * (1 - ci**2)
    ct = np.sqrt(np.maximum(1 - sine2, 0))
    rs, rp = (one * ci - two * ct) / (one * ci + two * ct), (two * ci - one * ct) / (two * ci + one * ct)
    back = (sine2 >= 1) | (random.random(len(own)) < (rs**2 + rp**2) / 2)
    bent = ratio * d[own] + (ratio * ci - ct)[:, None] * normal
    d[own] = np.where(back[:, None], d[own] + 2 * ci[:, None] * normal, bent)
    through = own[~back]
    where[through] = beyond
    entered[through] |= beyond >= 0
