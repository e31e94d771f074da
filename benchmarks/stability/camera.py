"""The camera: from one electron to a full well, at every exposure's boundary, over 120 dB."""

from __future__ import annotations

from functools import partial

import numpy as np
from pydantic import TypeAdapter

from benchmarks.stability.case import Family, relative
from disco_twin.camera.sensor import add_dark, add_read_noise, expected_variance, integrate, quantise
from hw.base.arrays import F64
from hw.camera.bracket import Bracket
from hw.record import RawImage, Sensor, to_radiance
from hw.rig.rig_file import Response

FAMILY = Family("camera")
WELL, DECISION = 1e5, 7 / 16 * 1e5
SENSOR = Sensor(
    longest_exposure_s=1 / 30,
    steps=12,
    bits=12,
    gain_e_per_dn=WELL / 4031,
    read_noise_e=25.0,
    dark_e_per_s=500.0,
    offset_dn=64.0,
    responsivity=(1e13,),
    decision_e=DECISION,
)
PIXELS = (200, 200)
SIGMA = 4.5  # standard errors; one case in 150,000 by chance


def records(rate: float, seed: int = 0) -> RawImage:
    """One record of pixels that all receive `rate` electrons a second."""
    rng = np.random.default_rng(seed)
    light = add_dark(np.full(PIXELS, rate), SENSOR)
    return quantise(add_read_noise(integrate(light, SENSOR, rng), SENSOR, rng), SENSOR)


def bias(rate: float, naive: bool = False) -> float:
    """Standard errors by which the mean radiance is off. naive: charge over time, whatever the decision selected."""
    raw = records(rate)
    found = to_radiance(raw, SENSOR, 0).radiance.astype(np.float64) * SENSOR.responsivity[0]
    if naive:
        time = np.ldexp(SENSOR.longest_exposure_s, -raw.exponent.astype(int))
        found = (raw.charge - SENSOR.offset_dn) * SENSOR.gain_e_per_dn / time - SENSOR.dark_e_per_s
    return float(abs(found.mean() - rate) / (found.std() / np.sqrt(found.size)))


def variance_error(rate: float) -> float:
    """Relative error of the stated variance, mean over the pixels, against their scatter."""
    found = to_radiance(records(rate), SENSOR, 0)
    return abs(float(found.variance.mean(dtype=np.float64) / found.radiance.var(dtype=np.float64)) - 1)


for electrons in (0.0, 1.0, 30.0, 1e3):
    FAMILY.case(
        f"{electrons:g} electrons in the longest exposure",
        "the mean radiance is unbiased",
        f"{electrons:g} e-",
        SIGMA,
    )(partial(bias, electrons / SENSOR.longest_exposure_s))
for step in range(12):
    edge = np.ldexp(DECISION, step) / SENSOR.longest_exposure_s
    FAMILY.case(
        f"charge at the boundary of exposure {step}",
        "the mean radiance is unbiased, whichever exposure was chosen",
        f"{DECISION:g} e- in T / {2**step}",
        SIGMA,
        rivals={"charge over time": partial(bias, edge, naive=True)},
    )(partial(bias, edge))
for name, share in (("dark", 0.0), ("one electron", 1e-5), ("half a decision", 0.2), ("between two exposures", 1.25)):
    FAMILY.case(
        f"stated variance, {name}", "the mean stated variance is the pixels' scatter", f"{share * WELL:g} e-", 0.04
    )(partial(variance_error, share * WELL / SENSOR.longest_exposure_s))


@FAMILY.case(
    "stated variance where the exposure is in doubt",
    "the pixels' scatter, but for what taking out the bias adds",
    f"{DECISION:g} e- in T / 4",
    0.2,
)
def doubtful() -> float:
    return variance_error(4 * DECISION / SENSOR.longest_exposure_s)


@FAMILY.case("a ramp over 120 dB", "radiance linear in light within a per cent of noise-free means", "120 dB", SIGMA)
def ramp() -> float:
    rates = np.geomspace(1.0, 1e6, 13) * 30 / SENSOR.longest_exposure_s
    return max(bias(float(rate)) for rate in rates)


@FAMILY.case("a laser straight into the lens", "every pixel is flagged as saturated, nothing overflows", "1e30 e-/s")
def dazzled() -> float:
    found = to_radiance(records(1e30), SENSOR, 0)
    return float((~found.saturated).sum() + (~np.isfinite(found.radiance)).sum())


@FAMILY.case("saturation is flagged exactly at full scale", "4094 is not, 4095 is", "12 bits")
def full_scale() -> float:
    raw = RawImage(np.full((1, 2), 11, np.uint8), np.array([[4094, 4095]], np.uint16))
    return float((to_radiance(raw, SENSOR, 0).saturated != [[False, True]]).sum())


def out_of_single(sensor: Sensor, exponent: int, charge: int) -> float:
    """1 for a pixel whose radiance is not finite, or whose variance is not above 0 and finite, in single precision."""
    found = to_radiance(RawImage(np.full((1, 1), exponent, np.uint8), np.full((1, 1), charge, np.uint16)), sensor, 0)
    return float(not (np.isfinite(found.radiance) & np.isfinite(found.variance) & (found.variance > 0)).all())


# ---------------------------------------------------------------- a rig file's and a record's outermost sensors
MOST = TypeAdapter(Response).json_schema()["maximum"]
for name, extent, sensor, exponent, charge in (
    ("most", f"{MOST:g} e-/s per W/(mm^2 sr)", Sensor(10.0, 1, 12, 1e-6, 0.0, 0.0, 64.0, (MOST,)), 0, 64),
    ("least", "1e-3 e-/s per W/(mm^2 sr)", Sensor(1e-9, 24, 16, 1e9, 1e12, 0.0, 0.0, (1e-3,)), 23, 65535),
):
    FAMILY.case(f"the {name} sensitive pixel that is allowed", "the variance is above 0 and finite", extent)(
        partial(out_of_single, sensor, exponent, charge)
    )


@FAMILY.case("predicted variance of radiance that is not light", "finite and positive, of 0 and below 0", "-1 .. 0")
def below_zero() -> float:
    found = expected_variance(np.array([-1.0, -1e-12, 0.0]), SENSOR, 0)
    return float((~(np.isfinite(found) & (found > 0))).sum())


def bracketed(light: F64, full: int = 4000) -> F64:
    """Electrons of noise-free pixels by a bracket of twelve exposures of a linear sensor of 12 bits."""
    bracket = Bracket(1.0, tuple(range(12)), 12, full)
    frames = ((k, np.minimum(np.rint(light * 2.0**-k), 4095).astype(np.uint16)) for k in bracket.exponents)
    raw = bracket.merge(frames)
    return np.asarray(raw.charge * 2.0**raw.exponent)


@FAMILY.case("a bracket over 120 dB", "every pixel within half a digit of its own exposure", "1 .. 8e6 digits", 0.501)
def bracket() -> float:
    light = np.geomspace(1, 3999 * 2.0**11, 400)[None]
    raw = bracketed(light)
    width = np.maximum(2.0 ** np.ceil(np.log2(light / 3999.5)), 1.0)
    return float(np.max(np.abs(raw - light) / width))


@FAMILY.case("a response that is a straight line", "the same radiance as without one", "257 entries", 1e-5)
def straight_response() -> float:
    from dataclasses import replace

    raw = RawImage(np.zeros((64, 64), np.uint8), np.arange(4096, dtype=np.uint16).reshape(64, 64))
    curved = replace(SENSOR, response=tuple(np.linspace(0, 1, 257)), decision_e=0.0)
    plain = to_radiance(raw, replace(SENSOR, decision_e=0.0), 0).radiance
    keep = raw.charge > 80
    return relative(to_radiance(raw, curved, 0).radiance[keep], plain[keep])
