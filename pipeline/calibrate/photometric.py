"""White balance, and laser power over time, from a white scattering plate under each laser (thesis 4.5).

The plate's light, summed over all pixels with the area that each sees, is the laser's power times what the plate is
known to scatter. The photodiode's reading at the same moment divides the power out, so that neither warm-up nor noise
nor a mode hop matters, and what remains is one factor per camera and laser.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hw.base.arrays import F64, I64
from pipeline.geometry.camera import PinholeCamera

PLACE_SHARE = 2e-4  # a board's corners tell its plane's area to about this
PLACE_FREEDOM = 1.5  # few: places that do differ by far more than that are believed
PLACE_LARGEST = 0.02  # more would be a plate that was mistaken for another


@dataclass(frozen=True)
class Places:
    """The places of the plate before one camera: what was found at each, (P,) relative to the mean of all exposures and
    with all lasers together; variance: (P,) of its noise; weight: (P,) share of the exposures.
    """

    found: F64
    variance: F64
    weight: F64


@dataclass(frozen=True)
class WhiteBalance:
    """factor: (L,) what radiances are to be multiplied with, so that they agree with the photodiode; error: (L,) of it.

    Light that the lens throws outside the image is part of the factor: images of the object lose the same share. The
    error does not contain that of the plate's own share, which is alike for all cameras.

    drift: (L,) (largest - smallest) / mean of the plate's light over the whole time; scatter: (L,) standard deviation
    of the same after division by the photodiode, exposure by exposure (speckle on the plate included)

    places: `with_places` adds to the error what the plate's places differ by; until then it is speckle's alone.
    """

    factor: F64
    error: F64
    drift: F64
    scatter: F64
    places: Places


def pixel_areas(camera: PinholeCamera, plane: F64) -> F64:
    """(H, W) mm^2 of a plane that each pixel sees; plane: (4, 4) plane -> camera, the plane is z = 0.

    camera: in its own frame (its pose is not used)
    """
    rays = camera.ahead(camera.pixel_centres())
    normal, shift = plane[:3, 2], plane[:3, 3]
    depth = (shift @ normal) / (rays @ normal)
    slope = np.abs(rays @ normal)  # cosine to the plane times the ray's length
    return np.asarray((depth**2 / camera.focal.prod() / slope).reshape(camera.height, camera.width))


def balance(light: F64, reading: F64, share: F64, place: I64) -> WhiteBalance:
    """light: (L, N) sums of radiance times area in W/sr; reading: (L, N) photodiode, W; share: (L,) of the plate.

    place: (N,) which exposures were made in one place of the plate; a plate's pose errs for all of them alike

    Exposures of one place scatter by speckle, which the error is of.
    """
    ratio = np.pi * light / (share[:, None] * reading)
    places, which, count = np.unique(place, return_inverse=True, return_counts=True)
    mean = np.stack([ratio[:, place == p].mean(axis=1) for p in places], axis=1)
    rest = ratio / mean[:, which] - 1
    scatter = np.sqrt((rest**2).sum(axis=1) / max(rest.shape[1] - len(places), 1))
    value = ratio.mean(axis=1)
    number = ratio.shape[1]
    weight = 1.0 / np.maximum(scatter, 1e-6) ** 2  # light without any noise, as in a test, has a scatter of zero
    found = Places(weight @ (mean / value[:, None]) / weight.sum(), 1.0 / (weight.sum() * count), count / number)
    drift = (light.max(axis=1) - light.min(axis=1)) / light.mean(axis=1)
    return WhiteBalance(1.0 / value, scatter / (np.sqrt(number) * value), drift, scatter, found)


def with_places(balances: Sequence[WhiteBalance]) -> list[WhiteBalance]:
    """The white balances of all cameras, their errors with that of the plate's poses.

    That one is alike for all exposures and lasers of a place, and of one standard deviation for all places and cameras.
    """
    share = place_variance([b.places for b in balances])
    own = [share * float(b.places.weight @ b.places.weight) for b in balances]
    return [replace(b, error=np.hypot(b.error, np.sqrt(v) * b.factor)) for b, v in zip(balances, own, strict=True)]


def place_variance(cameras: Sequence[Places]) -> float:
    """Expected square of what each place is off by, as a share.

    The places' standard deviation has Student's half-t distribution about zero as prior (Gelman 2006), for a few places
    alone hardly tell it; every camera's mean is integrated out. The integral over the standard deviation is a sum, up
    to `PLACE_LARGEST`. Where every camera saw one place only, what is left is the prior's: .09 %.
    """
    spread = np.geomspace(1e-2 * PLACE_SHARE, PLACE_LARGEST, 400)
    likely = -0.5 * (PLACE_FREEDOM + 1.0) * np.log1p((spread / PLACE_SHARE) ** 2 / PLACE_FREEDOM)
    for places in cameras:
        precision = 1.0 / (places.variance + spread[:, None] ** 2)
        mean = (precision * places.found).sum(axis=1) / precision.sum(axis=1)
        likely += 0.5 * (np.log(precision).sum(axis=1) - np.log(precision.sum(axis=1)))
        likely -= 0.5 * (precision * (places.found - mean[:, None]) ** 2).sum(axis=1)
    share = np.exp(likely - likely.max()) * spread  # d(spread) = spread d(log spread)
    return float(share @ spread**2 / share.sum())
