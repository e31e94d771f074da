"""Power-of-two exposure bracketing: a linear sensor's frames as one record of the Lars III's kind.

Exposure k lasts `longest * 2**-k`. Every pixel keeps the longest exposure that did not saturate, as (exponent k,
charge): thesis 4.3 in several frames instead of one. A pixel that is saturated in the shortest exposure as well shows
the converter's full scale, whatever the sensor's own level is, which `hw.record.to_radiance` recognises.

The exposure is chosen by the charge that is kept, which biases pixels within the noise of the saturation level: at a
full well of 1e4 electrons by at most .4 % of the pixel, in a band of 2 % of the range. `hw.record.Sensor.decision_e`
is therefore 0 for a bracket.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from hw.base.arrays import U16
from hw.base.errors import InputError
from hw.record import RawImage


@dataclass(frozen=True)
class Bracket:
    """The exposures of one image and what the sensor's digital numbers mean.

    exponents: halvings of the longest exposure, ascending from 0; saturation_dn: from here on the sensor is not linear

    Raises: InputError for exposures or a saturation that no sensor of so many bits has.
    """

    longest_exposure_s: float
    exponents: tuple[int, ...]
    bits: int
    saturation_dn: int

    def __post_init__(self) -> None:
        ascending = tuple(sorted(set(self.exponents)))
        if not ascending or self.exponents != ascending or ascending[0] != 0 or ascending[-1] > 23:
            allowed = "ascending from 0, at most 23"
            raise InputError("not a bracket", key="exponents", value=self.exponents, allowed=allowed,
                             remedy="name every exposure once, the longest first")  # fmt: skip
        if not 0 < self.saturation_dn <= self.full_scale_dn:
            problem, allowed = f"not on the scale of {self.bits} bits", f"1 to {self.full_scale_dn}"
            remedy = "correct saturation_dn or bits"
            raise InputError(problem, key="saturation_dn", value=self.saturation_dn, allowed=allowed, remedy=remedy)

    @property
    def full_scale_dn(self) -> int:
        """The largest digital number."""
        return (1 << self.bits) - 1

    def exposure_s(self, exponent: int) -> float:
        """Seconds of one exposure of the bracket."""
        return self.longest_exposure_s * 2.0**-exponent

    def merge(self, frames: Iterable[tuple[int, U16]]) -> RawImage:
        """(exponent, (height, width) uint16 digital numbers) by falling exposure -> the record.

        Takes no further frame from the iterable once no pixel is saturated: a camera need not make it.
        """
        record: RawImage | None = None
        for exponent, pixels in frames:
            if record is None:
                record = RawImage(np.full(pixels.shape, exponent, np.uint8), pixels.copy())
                waiting = pixels >= self.saturation_dn
            else:
                record.exponent[waiting] = exponent
                record.charge[waiting] = pixels[waiting]
                waiting &= pixels >= self.saturation_dn
            if not waiting.any():
                return record
        if record is None:
            raise ValueError("a bracket needs at least one frame")
        record.charge[waiting] = self.full_scale_dn
        return record
