"""The lens in front of a sensor: what it does to the radiance of a scene before a pixel sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from hw.base.arrays import F32
from pipeline.geometry.camera import PinholeCamera

GLARE_SHARE = 0.005  # of the light; thesis 4.3 asks for a high quality lens, whose veiling glare is below a percent


def vignetting(camera: PinholeCamera) -> F32:
    """(height, width) transmission relative to the axis: cos^4 of the angle between a pixel's ray and the axis."""
    _, directions = camera.rays(camera.pixel_centres())
    cosine = directions @ camera.pose[2, :3]
    return (cosine**4).astype(np.float32).reshape(camera.height, camera.width)


@dataclass(frozen=True)
class Glare:
    """Veiling glare and flare: a share of every pixel's light lands in a wide halo and in a uniform veil.

    transform: real Fourier transform of the (2 height - 1, 2 width - 1) spread function, which sums to GLARE_SHARE.
    Light that the halo throws outside the image is lost, as it is in a camera.
    """

    height: int
    width: int
    transform: NDArray[np.complex64]

    @classmethod
    def of(cls, height: int, width: int) -> Glare:
        """Half of the glare in a halo that falls as (1 + (r/r0)^2)^(-3/2), r0 = width/64; half as a uniform veil."""
        rows, columns = 2 * height - 1, 2 * width - 1
        y = np.minimum(np.arange(rows), rows - np.arange(rows))[:, None]
        x = np.minimum(np.arange(columns), columns - np.arange(columns))[None, :]
        halo = (1.0 + (x * x + y * y) / (width / 64.0) ** 2) ** -1.5
        spread = GLARE_SHARE * (0.5 * halo / halo.sum() + 0.5 / halo.size)
        return cls(height, width, scipy.fft.rfft2(spread.astype(np.float32)))

    def kept(self) -> float:
        """Share of the light of the image's middle that stays in the image; of other places nearly the same."""
        middle = np.zeros((self.height, self.width), np.float32)
        middle[self.height // 2, self.width // 2] = 1.0
        return float(self(middle).sum(dtype=np.float64))

    def __call__(self, image: F32) -> F32:
        """(height, width) radiance -> the same with its glare."""
        shape = (2 * self.height - 1, 2 * self.width - 1)
        spread = scipy.fft.irfft2(scipy.fft.rfft2(image, s=shape) * self.transform, s=shape)
        halo = np.maximum(spread[: self.height, : self.width], 0.0)  # the transform's rounding may dip below zero
        return np.asarray((1.0 - GLARE_SHARE) * image + halo, np.float32)
