"""The raw record and what it says about radiance."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from hw.base.errors import DiscoError, InputError
from hw.record import RawImage, Sensor, to_radiance

SENSOR = Sensor(1 / 30, 12, 12, 24.4, 25.0, 500.0, 64.0, (3.0e12, 2.0e12, 1.0e12))


def expose(radiance: np.ndarray, exponent: int, laser: int, random: np.random.Generator) -> RawImage:
    """A camera written down from the record's definition alone: Poisson charge, Gaussian read noise, rounding."""
    time = SENSOR.longest_exposure_s / 2**exponent
    electrons = random.poisson((radiance * SENSOR.responsivity[laser] + SENSOR.dark_e_per_s) * time).astype(float)
    electrons += SENSOR.read_noise_e * random.standard_normal(radiance.shape)
    charge = np.clip(np.rint(electrons / SENSOR.gain_e_per_dn + SENSOR.offset_dn), 0, SENSOR.saturation_dn)
    return RawImage(np.full(radiance.shape, exponent, np.uint8), charge.astype(np.uint16))


@pytest.mark.parametrize("laser", [0, 2])
@pytest.mark.parametrize(("level", "exponent"), [(0.0, 0), (1e-9, 0), (1e-7, 1), (1e-6, 3), (5e-5, 10)])
def test_radiance_is_unbiased_and_its_variance_true(level: float, exponent: int, laser: int) -> None:
    """Rationale: a record made by the definition must give back its radiance within its stated noise.

    Expected: mean within 5 standard errors; the scatter of pull = (L - truth) / stated sigma is 1 within 5 standard
    errors of a standard deviation (1 / sqrt(2 n)) plus 2 % for the variance being estimated from noisy charge.
    """
    random = np.random.default_rng(7)
    n = 40_000
    seen = to_radiance(expose(np.full((200, 200), level), exponent, laser, random), SENSOR, laser)
    pull = (seen.radiance.astype(float) - level) / np.sqrt(seen.variance)
    spread = float(np.std(seen.radiance, dtype=float))
    assert abs(float(seen.radiance.mean(dtype=float)) - level) < 5 * spread / np.sqrt(n)
    assert abs(pull.std() - 1) < 5 / np.sqrt(2 * n) + 0.02
    assert not seen.saturated.any()


def test_one_pixel_by_hand() -> None:
    """1064 DN at half the longest exposure: (1064 - 64) * 24.4 e, less 500 e/s * 1/60 s of dark signal."""
    raw = RawImage(np.array([[1]], np.uint8), np.array([[1064]], np.uint16))
    seen = to_radiance(raw, SENSOR, 1)
    assert seen.radiance[0, 0] == pytest.approx((1000 * 24.4 - 500 / 60) / (2.0e12 / 60), rel=1e-6)
    assert seen.variance[0, 0] == pytest.approx((24400 + 625 + 24.4**2 / 12) / (2.0e12 / 60) ** 2, rel=1e-6)


@pytest.mark.parametrize(
    ("sensor", "exponent", "charge"),
    [
        (Sensor(1 / 30, 12, 12, 1e-6, 0.0, 0.0, 64.0, (1e18,)), 0, 64),
        (Sensor(1e-9, 24, 16, 1e9, 0.0, 0.0, 0.0, (1e-3,)), 23, 65535),
    ],
    ids=["0 in single precision", "inf in single precision"],
)
def test_a_variance_beyond_single_precision_stays_above_0_and_finite(
    sensor: Sensor, exponent: int, charge: int
) -> None:
    seen = to_radiance(RawImage(np.array([[exponent]], np.uint8), np.array([[charge]], np.uint16)), sensor, 0)
    assert 0 < seen.variance[0, 0] < np.inf
    assert 0 < np.float32(1) / seen.variance[0, 0] < np.inf


def test_saturated_means_full_charge() -> None:
    exponent = np.array([[11, 11, 10]], np.uint8)
    charge = np.array([[4095, 4094, 4095]], np.uint16)
    assert to_radiance(RawImage(exponent, charge), SENSOR, 0).saturated.tolist() == [[True, False, True]]


def test_records_of_one_radiance_agree_whatever_the_exposure() -> None:
    """Noise-free charge at every step that does not saturate: equal radiance to the rounding of one count."""
    level = 1e-7
    values = []
    for exponent in range(12):
        time = SENSOR.longest_exposure_s / 2**exponent
        counts = (level * SENSOR.responsivity[0] + SENSOR.dark_e_per_s) * time / SENSOR.gain_e_per_dn
        raw = RawImage(np.array([[exponent]], np.uint8), np.array([[round(counts + 64)]], np.uint16))
        seen = to_radiance(raw, SENSOR, 0)
        step = SENSOR.gain_e_per_dn / (time * SENSOR.responsivity[0])
        values.append(abs(float(seen.radiance[0, 0]) - level) / step)
    assert max(values) <= 0.5 + 1e-3


def test_input_error_is_one_line_with_everything_in_it() -> None:
    error = InputError("out of range", file="a.toml", key="x.y", value=-1, allowed="0 to 1", remedy="use 0.5")
    assert isinstance(error, DiscoError)
    assert str(error) == "a.toml: x.y = -1: out of range (allowed: 0 to 1). Remedy: use 0.5"


def test_hw_needs_no_renderer_and_no_pipeline() -> None:
    code = (
        "import sys, hw, hw.base.errors, hw.interface, hw.record; "
        "print([m for m in ('mitsuba', 'drjit', 'pipeline', 'disco_twin') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
