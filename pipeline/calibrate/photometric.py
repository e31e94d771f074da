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

    Exposures of one place scatter by speckle; places differ by a variance of their own, alike for all lasers: what
    their means differ by beyond that scatter (variance components, the moments of DerSimonian and Laird 1986). As
    n + 1 places leave it n degrees of freedom, it counts n / (n - 2) times (Student); two or three places, for which
    that does not exist, 5 and 4 times. One place tells nothing of it.
    """
    ratio = np.pi * light / (share[:, None] * reading)
    places, which, count = np.unique(place, return_inverse=True, return_counts=True)
    mean = np.stack([ratio[:, place == p].mean(axis=1) for p in places], axis=1)
    rest = ratio / mean[:, which] - 1
    scatter = np.sqrt((rest**2).sum(axis=1) / max(rest.shape[1] - len(places), 1))
    value = ratio.mean(axis=1)
    freedom, number = len(places) - 1, ratio.shape[1]
    by_place = float((count / number) @ (count / number))  # of the places' variance, what is left of it in the mean
    common = 0.0
    if freedom:
        apart = (count * (mean / value[:, None] - 1) ** 2).sum(axis=1) - freedom * scatter**2
        common = max(float(apart.mean()) / (number * (1.0 - by_place)), 0.0)
    student = freedom / (freedom - 2.0) if freedom > 3 else 6.0 - freedom
    error = np.sqrt(scatter**2 / number + student * common * by_place)
    drift = (light.max(axis=1) - light.min(axis=1)) / light.mean(axis=1)
    return Balance(1.0 / value, error / value, drift, scatter)
