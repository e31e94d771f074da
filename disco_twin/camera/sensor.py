"""The steps of a sensor whose pixels end their own exposure, from irradiated pixels to digital numbers.

Every step is a function of arrays of one shape, mostly (height, width); units stand in the docstrings. The steps are
listed in the order of the light's way through the sensor by `disco_twin.camera.lars3.Lars3`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from hw.base.arrays import F64
from hw.record import RawImage, Sensor

GAMMA, FOOT = 2.2, 0.02  # of a camera whose response is "curved"


class Exposed(NamedTuple):
    """exponent: int32, halvings of the longest exposure; charge: float64, electrons in the well."""

    exponent: NDArray[np.int32]
    charge: F64


def photoelectrons(radiance: NDArray[np.floating], sensor: Sensor, laser: int) -> F64:
    """W/(mm^2 sr) -> mean photoelectrons per second."""
    return radiance.astype(np.float64) * sensor.responsivity[laser]


def add_dark(rate: F64, sensor: Sensor) -> F64:
    """Electrons per second -> the same with the dark signal, which is collected and decided upon like light."""
    return rate + sensor.dark_e_per_s


def integrate(rate: F64, sensor: Sensor, rng: Generator) -> Exposed:
    """Electrons per second -> the step at which each pixel stops and its charge in electrons, with shot noise.

    At the times T 2^-(steps-1), ..., T/2, T the pixel asks whether it would be overexposed at the next step given
    constant irradiance (thesis 4.3), that is whether it has more than c = `decision_e` electrons, and stops if so.
    Its charge is a Poisson process, so only two steps are in doubt: let t be the first with a mean charge of at least
    c/sqrt(2). Half the time before, the mean is below .71 c, at twice the time it is above 1.41 c, and for c >= 400
    both wrong decisions are 7 sigma away (1e-12). Hence one Poisson draw at t, a second one for those who go on.
    """
    longest = rate * sensor.longest_exposure_s
    _, power = np.frexp(longest * (np.sqrt(2.0) / sensor.decision_e))
    exponent = np.clip(power - 1, 0, sensor.steps - 1)
    mean = np.ldexp(longest, -exponent)
    np.minimum(mean, 1e12, out=mean)  # a laser straight into the lens: far above any well, within Poisson's range
    charge = rng.poisson(mean).astype(np.float64)
    on = (charge <= sensor.decision_e) & (exponent > 0)
    charge[on] += rng.poisson(mean[on])
    return Exposed(exponent - on, charge)


def expected_variance(radiance: F64, sensor: Sensor, laser: int) -> F64:
    """Variance that the camera adds to a radiance, same shape, in (W/(mm^2 sr))^2: photons, dark signal, read-out and
    digits, at the exposure that `integrate` chooses in the mean. What is below 0, by noise, counts as dark.
    """
    rate = photoelectrons(np.maximum(radiance, 0.0), sensor, laser) + sensor.dark_e_per_s
    longest = rate * sensor.longest_exposure_s
    with np.errstate(divide="ignore"):
        halvings = np.ceil(np.log2(longest / max(sensor.decision_e, 1e-9))) - 1
    time = np.ldexp(sensor.longest_exposure_s, -np.clip(halvings, 0, sensor.steps - 1).astype(int))
    noise = rate * time + sensor.read_noise_e**2 + sensor.gain_e_per_dn**2 / 12
    return np.asarray(noise / (time * sensor.responsivity[laser]) ** 2)


def add_read_noise(exposed: Exposed, sensor: Sensor, rng: Generator) -> Exposed:
    """Electrons -> electrons: the Gaussian noise of the read-out chain, independent of exposure and charge."""
    noise = rng.standard_normal(exposed.charge.shape)
    return Exposed(exposed.exponent, exposed.charge + sensor.read_noise_e * noise)


def compress(exposed: Exposed, sensor: Sensor) -> Exposed:
    """Electrons -> electrons that a linear camera would have to show the same: a gamma curve with a straight foot."""
    well = (sensor.saturation_dn - sensor.offset_dn) * sensor.gain_e_per_dn
    share = exposed.charge / well
    return Exposed(exposed.exponent, well * np.sign(share) * gamma_curve(np.abs(share)))


def gamma_curve(share: F64) -> F64:
    """0..1 of the full well -> 0..1 of the digital range; the pipeline is not given it."""
    power = 1.0 / GAMMA
    low, high = FOOT**power, (1.0 + FOOT) ** power
    return np.asarray(((share + FOOT) ** power - low) / (high - low))


def integrate_for(rate: F64, sensor: Sensor, exponent: int, rng: Generator) -> Exposed:
    """Electrons per second -> the charge with shot noise after a time that is the same for all pixels."""
    mean = np.minimum(np.ldexp(rate * sensor.longest_exposure_s, -exponent), 1e12)
    return Exposed(np.full(rate.shape, exponent, np.int32), rng.poisson(mean).astype(np.float64))


def quantise(exposed: Exposed, sensor: Sensor) -> RawImage:
    """Electrons -> digital numbers, clipped to the converter's range: a full well and a full converter coincide."""
    counts = np.rint(exposed.charge / sensor.gain_e_per_dn + sensor.offset_dn)
    charge = np.clip(counts, 0, sensor.saturation_dn).astype(np.uint16)
    return RawImage(exposed.exponent.astype(np.uint8), charge)
