"""The camera's raw record (exposure exponent + charge per pixel) and the radiance that follows from it.

This is the Lars III's principle (thesis 4.3): every pixel decides at power-of-two time steps whether it has
received enough light, and stores the step and the charge. A bracketed GenICam camera fills the same record.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from hw.base.arrays import F32, F64, U8, U16, Bool

SINGLE = np.finfo(np.float32)

# Bounds of what files state; they are checked where a file is read.
NotNegative = Annotated[float, Field(ge=0, le=1e12, allow_inf_nan=False)]
Exposure = Annotated[float, Field(ge=1e-9, le=1e4, allow_inf_nan=False)]
Gain = Annotated[float, Field(ge=1e-6, le=1e9, allow_inf_nan=False)]
Responsivity = Annotated[float, Field(ge=1e-3, le=1e18, allow_inf_nan=False)]  # far beyond either end of sensors
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


@dataclass(frozen=True)
class RawImage:
    """One raw image. Pixel (row, column) integrated for `longest_exposure_s * 2**-exponent` seconds.

    exponent: (height, width) uint8, number of halvings of the longest exposure
    charge:   (height, width) uint16, digitised charge in counts (DN)
    """

    exponent: U8
    charge: U16


@dataclass(frozen=True)
class Sensor:
    """What is known of a sensor: enough to turn a record into radiance with its variance.

    responsivity: electrons per second per pixel for a radiance of 1 W/(mm^2 sr), one value per laser
    decision_e: a pixel stops at the first step that finds more than this charge in electrons (the longest exposure
        ends in any case); 0 where the exponent was not decided on the charge that is stored, as in a bracket
    response: share of the full scale's charge that evenly spaced shares of the digital range (above the offset) stand
        for, from 0 to 1; empty where both are the same. Below the offset it goes on as its mirror image
    """

    longest_exposure_s: Exposure
    steps: Annotated[int, Field(ge=1, le=24)]  # exponents run from 0 to steps - 1
    bits: Annotated[int, Field(ge=1, le=16)]  # the charge is digitised to 0 .. 2**bits - 1
    gain_e_per_dn: Gain
    read_noise_e: NotNegative
    dark_e_per_s: NotNegative
    offset_dn: NotNegative
    responsivity: Annotated[tuple[Responsivity, ...], Field(min_length=1)]
    decision_e: NotNegative = 0.0
    response: tuple[Share, ...] = ()

    @property
    def saturation_dn(self) -> int:
        """Largest digital number; a pixel that shows it is saturated."""
        return (1 << self.bits) - 1


@dataclass(frozen=True)
class RadianceImage:
    """radiance, variance: (height, width) float32 in W/(mm^2 sr) and its square; saturated: (height, width) bool.

    The radiance of a saturated pixel is a lower bound and its variance means nothing.
    """

    radiance: F32
    variance: F32
    saturated: Bool


def to_radiance(raw: RawImage, sensor: Sensor, laser: int) -> RadianceImage:
    """Linear radiance and its variance (photon, dark, read and quantisation noise) from one record.

    The radiance is unbiased, negative values included: nothing is clipped, and what the exposure decision does to the
    mean is taken out (`_decision_bias`). The variance is estimated from the same charge as the radiance, so weights
    1/variance of single pixels favour the low ones; average variances over neighbours before weighting with them. A
    variance beyond what single precision holds is stated as the nearest that it holds, which is above 0 and finite.
    """
    time = np.ldexp(sensor.longest_exposure_s, -raw.exponent.astype(np.int32))
    scale = 1.0 / (time * sensor.responsivity[laser])
    electrons, step = _electrons(raw.charge.astype(np.float64), sensor)
    dark = sensor.dark_e_per_s * time
    noise = np.maximum(electrons, dark) + sensor.read_noise_e**2 + step**2 / 12.0
    signal = electrons - dark
    if sensor.decision_e > 0:
        signal -= _decision_bias(electrons, raw.exponent, sensor)
    return RadianceImage(
        (signal * scale).astype(np.float32),
        np.clip(noise * scale**2, SINGLE.tiny, SINGLE.max).astype(np.float32),
        raw.charge >= sensor.saturation_dn,
    )


def _electrons(charge: F64, sensor: Sensor) -> tuple[F64, F64 | float]:
    """Digital numbers -> electrons, and how many electrons a digital number is wide there."""
    if not sensor.response:
        return (charge - sensor.offset_dn) * sensor.gain_e_per_dn, sensor.gain_e_per_dn
    span, knots = sensor.saturation_dn - sensor.offset_dn, np.linspace(0.0, 1.0, len(sensor.response))

    def linear(number: F64) -> F64:
        share = (number - sensor.offset_dn) / span
        return np.asarray(np.sign(share) * np.interp(np.abs(share), knots, sensor.response))

    well = span * sensor.gain_e_per_dn
    return linear(charge) * well, (linear(charge + 0.5) - linear(charge - 0.5)) * well


def _decision_bias(electrons: F64, exponent: U8, sensor: Sensor) -> F64:
    """Electrons by which the charge of a pixel that was let to integrate on is too high on average.

    A pixel goes on when it found at most c = `decision_e` electrons, so near the decision the unlucky ones go on and
    charge / time is too high by up to .2/sqrt(c) of itself: small, but it does not average out. The charge M half way
    is what the decision did not select by its own outcome, and (time, final charge N) is sufficient for the rate, so
    E[M | N, M <= c] is unbiased (Rao-Blackwell; Girshick, Mosteller and Savage 1946). M given N is binomial(N, 1/2),
    here normal: 2 E[M | N, M <= c] = N - sqrt(N) phi(z) / Phi(z) with z = (2c - N) / sqrt(N).
    """
    bias = np.zeros_like(electrons)
    double = 2.0 * sensor.decision_e
    near = (electrons > double - 7.0 * math.sqrt(double)) & (exponent < sensor.steps - 1)
    if near.any():
        root = np.sqrt(electrons[near])
        z = np.maximum((double - electrons[near]) / root, -30.0)
        below = np.array([0.5 * math.erfc(-x / math.sqrt(2.0)) for x in z])
        bias[near] = root * np.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * below)
    return bias
