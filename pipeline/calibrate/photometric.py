"""White balance, and laser power over time, from a white scattering plate under each laser (thesis 4.5).

The plate's light, summed over all pixels with the area that each sees, is the laser's power times what the plate is
known to scatter. The photodiode's reading at the same moment divides the power out, so that neither warm-up nor noise
nor a mode hop matters, and what remains is one factor per camera and laser.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.calibrate.camera import PinholeCamera

F64 = NDArray[np.float64]

PLACE_SHARE = 5e-4  # tan(45 degrees) times what a board's tilt is known to: by this much the plate's area errs
PLACE_FREEDOM = 2.0  # few: places that do differ by far more than that are believed


@dataclass(frozen=True)
class Balance:
    """factor: (L,) what radiances are to be multiplied with, so that they agree with the photodiode; error: (L,) of it.

    Light that the lens throws outside the image is part of the factor: images of the object lose the same share. The
    error does not contain that of the plate's own share, which is alike for all cameras.

    drift: (L,) (largest - smallest) / mean of the plate's light over the whole time; scatter: (L,) standard deviation
    of the same after division by the photodiode, exposure by exposure (speckle on the plate included)
    """

    factor: F64
    error: F64
    drift: F64
    scatter: F64


def pixel_areas(camera: PinholeCamera, plane: F64) -> F64:
    """(H, W) mm^2 of a plane that each pixel sees; plane: (4, 4) plane -> camera, the plane is z = 0.

    camera: in its own frame (its pose is not used)
    """
    xy = camera.undistort((camera.pixel_centres() - camera.centre) / camera.focal)
    rays = np.column_stack([xy, np.ones(len(xy))])
    normal, shift = plane[:3, 2], plane[:3, 3]
    depth = (shift @ normal) / (rays @ normal)
    slope = np.abs(rays @ normal)  # cosine to the plane times the ray's length
    return np.asarray((depth**2 / camera.focal.prod() / slope).reshape(camera.height, camera.width))


def balance(light: F64, reading: F64, share: F64, place: NDArray[np.int64]) -> Balance:
    """light: (L, N) sums of radiance times area in W/sr; reading: (L, N) photodiode, W; share: (L,) of the plate.

    place: (N,) which exposures were made in one place of the plate; a plate's pose errs for all of them alike

    Exposures of one place scatter by speckle; places differ by more than that, alike for all lasers, as far as the
    plate's poses err (`place_variance`).
    """
    ratio = np.pi * light / (share[:, None] * reading)
    places, which, count = np.unique(place, return_inverse=True, return_counts=True)
    mean = np.stack([ratio[:, place == p].mean(axis=1) for p in places], axis=1)
    rest = ratio / mean[:, which] - 1
    scatter = np.sqrt((rest**2).sum(axis=1) / max(rest.shape[1] - len(places), 1))
    value = ratio.mean(axis=1)
    number = ratio.shape[1]
    weight = 1.0 / np.maximum(scatter, 1e-6) ** 2  # light without any noise, as in a test, has a scatter of zero
    away = weight @ (mean / value[:, None]) / weight.sum()
    common = place_variance(away, 1.0 / (weight.sum() * count))
    error = np.sqrt(scatter**2 / number + common * float((count / number) @ (count / number)))
    drift = (light.max(axis=1) - light.min(axis=1)) / light.mean(axis=1)
    return Balance(1.0 / value, error / value, drift, scatter)


def place_variance(away: F64, variance: F64) -> float:
    """Expected square of what each place is off by, as a share.

    away: (P,) what was found at each place, relative to the mean; variance: (P,) of its noise. The places' standard
    deviation has Student's half-t distribution about zero as prior (Gelman 2006), for two or three places alone hardly
    tell it; the places' common mean is integrated out. The integral over the standard deviation is a sum.
    """
    spread = PLACE_SHARE * np.geomspace(1e-2, 1e3, 400)
    total = variance + spread[:, None] ** 2
    precision = 1.0 / total
    mean = (precision * away).sum(axis=1) / precision.sum(axis=1)
    likely = -0.5 * (np.log(total).sum(axis=1) + np.log(precision.sum(axis=1)))
    likely -= 0.5 * (precision * (away - mean[:, None]) ** 2).sum(axis=1)
    likely -= 0.5 * (PLACE_FREEDOM + 1.0) * np.log1p((spread / PLACE_SHARE) ** 2 / PLACE_FREEDOM)
    share = np.exp(likely - likely.max()) * spread  # d(spread) = spread d(log spread)
    return float(share @ spread**2 / share.sum())
