"""White balance, and laser power over time, from a white scattering plate under each laser (thesis 4.5).

The plate's light, summed over all pixels with the area that each sees, is the laser's power times what the plate is
known to scatter. The photodiode's reading at the same moment divides the power out, so that neither warm-up nor noise
nor a mode hop matters, and what remains is one factor per camera and laser.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from pipeline.calibrate.camera import PinholeCamera

F64 = NDArray[np.float64]

CHANCE = 1e-3  # that places differ as much by chance; if less probable, the plate's places count as the error


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
    """
    ratio = np.pi * light / (share[:, None] * reading)
    places, which, count = np.unique(place, return_inverse=True, return_counts=True)
    mean = np.stack([ratio[:, place == p].mean(axis=1) for p in places], axis=1)
    rest = ratio / mean[:, which] - 1
    scatter = np.sqrt((rest**2).sum(axis=1) / max(rest.shape[1] - len(places), 1))
    value = ratio.mean(axis=1)
    # Exposures of one place scatter by speckle alone; places differ by more only where a plate's pose is wrong.
    freedom = len(value) * (len(places) - 1)
    apart = float((count * ((mean / value[:, None] - 1) / scatter[:, None]) ** 2).sum())
    excess = np.sqrt(apart / freedom) if freedom and apart > chi2.isf(CHANCE, freedom) else 1.0
    drift = (light.max(axis=1) - light.min(axis=1)) / light.mean(axis=1)
    return Balance(1.0 / value, scatter * excess / np.sqrt(ratio.shape[1]) / value, drift, scatter)
