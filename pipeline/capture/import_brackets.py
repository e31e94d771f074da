"""Do the frames of one image go together as their exposures say? If not, what is the likeliest cause?

Two frames a (longer) and b of a linear sensor lie on a line, b - black = ratio (a - black), whose slope and black level
are compared with what exposures and powers let expect.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hw.base.arrays import F64, U16, Bool
from hw.base.errors import InputError
from hw.record import Sensor
from pipeline.capture.import_table import Frame

BRIGHT = 0.1  # of the range above the offset: pixels that show how two exposures go together
UNLIKE = 0.25  # by which their light may differ from what the exposures say; the nearest wrong exposure is half of it
OFFSET_DN = 2.0  # as far as an offset may be off
OFFSET_SHARE = 0.03  # of the light by which a black level is found: as much do exposures and responses bend it
LEAST_PIXELS = 32
CLIPPED = 20  # pixels of one number, the largest of all: there the sensor may clip
CLEAR = 400.0  # times the noise's variance, that light must vary by
CLOSE = 0.12  # share by which a cause may miss what was found


@dataclass(frozen=True)
class Pair:
    """Two frames of one image. ratio: light that the second should have of the first's; found: that it has, by its
    bright pixels, and by `sensor.offset_dn`; slope: by how much it rises with the first; None: too few pixels to tell.
    black_dn, black_error_dn: where both would show the same number, from their dark pixels
    exponent: power of the exposure that the numbers rise with: 1 of a linear camera, .45 of a picture for the screen
    What powers say of the light in a bracket is believed only where it brings the frames together.
    """

    ratio: float
    found: float | None
    agrees: bool
    slope: float | None
    black_dn: float | None
    black_error_dn: float
    exponent: float | None


def compare(longer: Frame, a: U16, shorter: Frame, b: U16, sensor: Sensor, saturation_dn: int) -> Pair:
    """Two frames of one image of a linear sensor, by falling exposure."""
    exposures = 2.0 ** (longer.exponent - shorter.exponent)
    ratio = exposures * (shorter.power_w / longer.power_w if longer.power_w else 1.0)
    charge, other = a.astype(np.float64) - sensor.offset_dn, b.astype(np.float64) - sensor.offset_dn
    linear = _unclipped(a, saturation_dn) & _unclipped(b, saturation_dn)
    span, noise_dn = saturation_dn - sensor.offset_dn, sensor.read_noise_e / sensor.gain_e_per_dn
    bright, dark = linear & (charge > BRIGHT * span), linear & (charge <= BRIGHT * span)
    first, light = float(charge[bright].sum()), float(other[bright].sum())
    many = int(np.count_nonzero(bright))
    noise = math.sqrt(max(first * ratio, 0.0) / sensor.gain_e_per_dn + many * noise_dn**2)
    found = light / first if many >= LEAST_PIXELS and first > 0 else None
    blacks = [_black(charge, other, dark, each, noise_dn) for each in (exposures, ratio)]
    black, error = min(blacks, key=lambda one: math.inf if one[0] is None else abs(one[0]))
    slope = _slope(charge, other, linear, noise_dn)
    powers = [math.log(slope) / math.log(r) for r in (exposures, ratio) if slope and 0 < slope < 1 and 0 < r < 0.9]
    return Pair(
        ratio,
        found,
        abs(light - first * ratio) <= UNLIKE * first * ratio + OFFSET_DN * many + 5 * noise,
        slope,
        None if black is None else black + sensor.offset_dn,
        error,
        min(powers, key=lambda power: abs(power - 1), default=None),
    )


def _unclipped(pixels: U16, saturation_dn: int) -> Bool:
    """(H, W) pixels below a frame's largest number, if many show it: whether it is clipped, all frames tell."""
    top = int(pixels.max())
    clips = np.count_nonzero(pixels == top) >= CLIPPED
    return np.asarray(pixels < min(saturation_dn, top if clips else top + 1))


def _black(charge: F64, other: F64, dark: Bool, ratio: float, noise_dn: float) -> tuple[float | None, float]:
    """Black level above the stated one from pixels in the dark, and what it may be off, in DN."""
    many = int(np.count_nonzero(dark))
    if many < LEAST_PIXELS or not 0 < ratio < 0.9:
        return None, math.inf
    a, b = float(charge[dark].mean()), float(other[dark].mean())
    black = (b - ratio * a) / (1 - ratio)
    error = OFFSET_DN + OFFSET_SHARE * abs(a - black) / (1 - ratio) + 5 * (noise_dn + 0.5) / math.sqrt(many)
    return black, error


def _slope(charge: F64, other: F64, linear: Bool, noise_dn: float) -> float | None:
    """d other / d charge over all pixels that are linear in both; None where noise would flatten it."""
    if np.count_nonzero(linear) < LEAST_PIXELS:
        return None
    a, b = charge[linear] - charge[linear].mean(), other[linear] - other[linear].mean()
    square = float((a * a).sum())
    return float((a * b).sum()) / square if square > CLEAR * a.size * (noise_dn**2 + 1 / 12) else None


def require_agreement(pair: Pair, longer: Frame, shorter: Frame, table: Path) -> None:
    """Raises: InputError where two frames cannot be exposures of one image, with the likeliest cause."""
    if pair.agrees or pair.found is None:
        return
    cause, remedy = _cause(pair)
    raise InputError(
        f"lines {longer.line} and {shorter.line} cannot be exposures of one image: the second should have "
        f"{pair.ratio:.3g} of the first's light and has {pair.found:.3g}{cause}",
        file=table, key="exposure_s", remedy=remedy,
    )  # fmt: skip


def _cause(pair: Pair) -> tuple[str, str]:
    """What would explain a pair, in words, and the remedy."""
    assert pair.found is not None

    def near(value: float | None, wanted: float) -> bool:
        return value is not None and abs(value / wanted - 1) < CLOSE

    general = "correct file, exposure_s or power_w, or leave the frame out"
    if near(pair.slope, pair.ratio) and pair.black_dn is not None:
        return f", unless black lies at {pair.black_dn:.0f} DN", f"correct sensor.offset_dn, or {general}"
    if near(pair.found, 1.0):
        return ", as the same exposure again would", general
    if near(pair.found, 1 / pair.ratio):
        return ", as if the two were exchanged", f"exchange their files, or {general}"
    if near(pair.found, pair.ratio**2):
        return ", as exposures in steps of two stops would", f"correct exposure_s, or {general}"
    if pair.exponent is not None and 0.3 < pair.exponent < 0.7:
        remedy = f"switch the camera's gamma off, correct exposure_s, or {general}"
        return f", as with a gamma of {1 / pair.exponent:.1f} or exposures in steps of half a stop", remedy
    return "", general
