"""The response of a camera that is not linear, from a bracket of exposures (Debevec and Malik 1997; thesis 4.3).

The Lars III needs none of it; a camera with a gamma curve or a logarithmic chip does, before its images mean radiance.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from hw.errors import InputError

F64 = NDArray[np.float64]

LEAST_EXPOSURES = 3
SMOOTHNESS = 20.0  # Debevec's lambda
SAMPLES = 200  # pixels that the curve is fitted to
EDGE = 8  # digital numbers at either end that say little: black and clipped


def response_curve(images: Sequence[NDArray[np.uint8]], seconds: Sequence[float]) -> F64:
    """(256,) relative exposure that each digital number stands for, 1 at 128, from a bracket of one scene."""
    if len(images) < LEAST_EXPOSURES or len(images) != len(seconds):
        raise InputError(
            "too few exposures of the scene", key="images", value=len(images), allowed=f"at least {LEAST_EXPOSURES}"
        )
    stack = [np.repeat(np.asarray(image, np.uint8)[:, :, None], 3, axis=2) for image in images]
    used = np.concatenate([np.ravel(i)[(np.ravel(i) > EDGE) & (np.ravel(i) < 255 - EDGE)] for i in stack])
    if not len(used) or int(used.max()) - int(used.min()) < 128:
        raise InputError(
            "the exposures do not cover the range of digital numbers",
            key="seconds",
            value=list(seconds),
            remedy="add longer and shorter exposures",
        )
    calibrate = cv2.createCalibrateDebevec(samples=SAMPLES, lambda_=SMOOTHNESS, random=False)
    curve = np.asarray(calibrate.process(stack, times=np.asarray(seconds, np.float32)), np.float64)[:, 0, 0]
    return np.asarray(curve / curve[128])


def linearised(image: NDArray[np.uint8], curve: F64) -> F64:
    """(H, W) digital numbers -> relative exposure."""
    return np.asarray(curve[image])
