"""The sensor and what `hw.record.to_radiance` makes of its records, against exact distributions and known inputs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from disco_twin.camera import sensor as steps
from disco_twin.camera.lars3 import Lars3, lars3_sensor
from disco_twin.scene.rig_schema import TwinRigConfig
from hw.record import RawImage, Sensor, to_radiance
from pipeline.geometry.nominal_rig import CameraConfig, LaserConfig, SensorConfig

F64 = NDArray[np.float64]
VIEW = CameraConfig(name="a", position_mm=(450, 0, 0), width=192, height=124)


def sensor_of(**changes: float) -> Sensor:
    """The default sensor, or one with a few figures changed."""
    return lars3_sensor(TwinRigConfig(cameras=(VIEW,), sensor=SensorConfig.model_validate(changes)))


def record(electrons_per_s: float, sensor: Sensor, n: int, seed: int) -> RawImage:
    """n pixels of one mean photocurrent."""
    camera = Lars3(sensor, np.ones((1, n), np.float32))
    # The chain is float32 at its entrance; the photocurrent is rounded alike wherever a test compares.
    radiance = np.full((1, n), electrons_per_s / sensor.responsivity[0], np.float32)
    return camera.expose(radiance, 0, np.random.default_rng(seed))


def z_of_mean(electrons_per_s: float, sensor: Sensor, n: int, seed: int, told: Sensor | None = None) -> float:
    """(mean radiance - truth) / standard error, from one record that is decoded as if by sensor `told`."""
    raw = record(electrons_per_s, sensor, n, seed)
    image = to_radiance(raw, sensor if told is None else told, 0)
    truth = float(np.float32(electrons_per_s / sensor.responsivity[0]))
    values = image.radiance.astype(np.float64)
    return float((values.mean() - truth) / (values.std(ddof=1) / np.sqrt(n)))


def chronological(rate: float, sensor: Sensor, n: int, rng: np.random.Generator) -> tuple[F64, F64]:
    """Reference: every pixel's Poisson process followed step by step. Returns exponents and electrons, (n,)."""
    charge, exponent = np.zeros(n), np.full(n, -1.0)
    before = 0.0
    for e in range(sensor.steps - 1, -1, -1):
        time = sensor.longest_exposure_s * 2.0**-e
        running = exponent < 0
        charge[running] += rng.poisson(rate * (time - before), running.sum())
        exponent[running & ((charge > sensor.decision_e) | (e == 0))] = e
        before = time
    return exponent, charge


def test_range_is_about_120_db() -> None:
    sensor = sensor_of()
    full = (sensor.saturation_dn - sensor.offset_dn) * sensor.gain_e_per_dn
    ratio = full * 2 ** (sensor.steps - 1) / sensor.read_noise_e
    assert 120 <= 20 * np.log10(ratio) <= 140


def test_brightest_white_spot_fits() -> None:
    """10 mW on 2 mm, 60 % of it back from the illuminated disc as from a Lambertian surface: not saturated."""
    peak = 0.6 * 10e-3 / np.pi / np.pi
    sensor = sensor_of()
    for laser in range(3):
        shortest = sensor.longest_exposure_s / 2 ** (sensor.steps - 1)
        assert peak * sensor.responsivity[laser] * shortest < (sensor.saturation_dn - 100) * sensor.gain_e_per_dn


def test_stronger_laser_stops_the_lens_down() -> None:
    lasers = (LaserConfig(wavelength_nm=532, power_mw=10), LaserConfig(wavelength_nm=635, power_mw=40))
    sensor = lars3_sensor(TwinRigConfig(cameras=(VIEW,), lasers=lasers))
    assert sensor.responsivity[1] == pytest.approx(sensor_of().responsivity[0] / 4)
    assert sensor.responsivity[0] == pytest.approx(sensor_of().responsivity[1] / 4)


def test_ramp_over_120_db_is_linear() -> None:
    """Every level's mean within 4 standard errors, and within 1 % wherever photon noise allows to tell."""
    sensor, n = sensor_of(), 20_000
    top = 0.9 * sensor.longest_exposure_s**-1 * 2 ** (sensor.steps - 1) * 100_000
    told = 0
    for i, rate in enumerate(top * np.logspace(0, -6, 49)):
        image = to_radiance(record(rate, sensor, n, i), sensor, 0)
        truth = rate / sensor.responsivity[0]
        values = image.radiance.astype(np.float64)
        error = values.std(ddof=1) / np.sqrt(n)
        assert not image.saturated.any()
        assert abs(values.mean() - truth) < 4 * error
        if error < 0.0025 * truth:
            told += 1
            assert abs(values.mean() / truth - 1) < 0.01
        # the reported variance is the one that the values have: relative standard error sqrt(2/n) = 1 %
        assert image.variance.mean(dtype=np.float64) == pytest.approx(values.var(), rel=0.05)
    assert told == 49


# Means at the decision in units of the decision's charge: far, about and around it.
NEAR = (0.97, 0.99, 0.995, 1.0, 1.005, 1.01, 1.03)


@pytest.mark.parametrize("exponent", [1, 6, 11])
@pytest.mark.parametrize("figures", [{}, {"full_well_e": 10_000, "read_noise_e": 8}])
def test_decision_does_not_bias_the_mean(exponent: int, figures: dict[str, float]) -> None:
    sensor = sensor_of(**figures)
    for i, share in enumerate(NEAR):
        rate = share * sensor.decision_e / sensor.longest_exposure_s * 2**exponent - sensor.dark_e_per_s
        assert abs(z_of_mean(rate, sensor, 200_000, 100 * exponent + i)) < 4


def test_decision_would_bias_the_naive_estimate() -> None:
    """The test above can see what it is for: charge over time alone is off by .2/sqrt(c) of the mean."""
    sensor = sensor_of()
    rate = sensor.decision_e / sensor.longest_exposure_s * 64 - sensor.dark_e_per_s
    assert z_of_mean(rate, sensor, 200_000, 1, told=replace(sensor, decision_e=0.0)) > 20


@pytest.mark.parametrize("electrons", [0.0, 1.0, 10.0, 100.0, 1000.0])
def test_low_charge_is_unbiased_with_its_variance(electrons: float) -> None:
    """Down to darkness: no clipping, negative values kept, exponent 0."""
    sensor, n = sensor_of(), 200_000
    rate = electrons / sensor.longest_exposure_s
    raw = record(rate, sensor, n, 3)
    image = to_radiance(raw, sensor, 0)
    assert (raw.exponent == 0).all()
    assert abs(z_of_mean(rate, sensor, n, 3)) < 4
    dark = sensor.dark_e_per_s * sensor.longest_exposure_s
    scale = 1 / (sensor.longest_exposure_s * sensor.responsivity[0])
    expected = (electrons + dark + sensor.read_noise_e**2 + sensor.gain_e_per_dn**2 / 12) * scale**2
    assert image.radiance.var(dtype=np.float64) == pytest.approx(expected, rel=4 * np.sqrt(2 / n))
    assert image.variance.mean(dtype=np.float64) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("exponent", [0, 5])
def test_photon_transfer_gives_back_gain_and_read_noise(exponent: int) -> None:
    """Variance against mean in DN at one exposure is a line: slope 1/gain, intercept (read/gain)^2 + 1/12."""
    sensor, n = sensor_of(), 50_000
    lowest = 0.0 if exponent == 0 else 1.1 * sensor.decision_e
    levels = np.linspace(lowest, (0.95 if exponent == 0 else 1.9) * sensor.decision_e, 12)
    mean, variance = np.empty(12), np.empty(12)
    for i, electrons in enumerate(levels):
        raw = record(electrons / sensor.longest_exposure_s * 2**exponent, sensor, n, 10 * i + exponent)
        assert (raw.exponent == exponent).all()
        mean[i], variance[i] = raw.charge.mean() - sensor.offset_dn, raw.charge.var(ddof=1)
    weight = 1 / (variance * np.sqrt(2 / n))
    fit, covariance = np.polyfit(mean, variance, 1, w=weight, cov="unscaled")
    slope_error, intercept_error = np.sqrt(np.diag(covariance))
    assert abs(fit[0] - 1 / sensor.gain_e_per_dn) < 4 * slope_error
    assert slope_error < 0.02 / sensor.gain_e_per_dn
    expected = (sensor.read_noise_e / sensor.gain_e_per_dn) ** 2 + 1 / 12
    assert abs(fit[1] - expected) < 4 * intercept_error
    if exponent == 0:
        assert intercept_error < 0.05 * expected


@pytest.mark.parametrize("share", [0.985, 0.995, 1.0, 1.005, 1.015])
def test_share_that_stops_at_the_decision_is_poisson(share: float) -> None:
    sensor, n = sensor_of(), 50_000
    mean = share * sensor.decision_e
    exposed = steps.integrate(np.full(n, mean / sensor.longest_exposure_s * 8), sensor, np.random.default_rng(5))
    assert set(np.unique(exposed.exponent)) <= {2, 3}
    expected = stats.poisson.sf(sensor.decision_e, mean)
    error = np.sqrt(expected * (1 - expected) / n)
    assert abs((exposed.exponent == 3).mean() - expected) < 4 * error


def test_exponent_far_from_the_decisions() -> None:
    """The first step at which the mean charge exceeds the decision's; ends of the range stay at the ends."""
    sensor = sensor_of()
    for exponent in range(sensor.steps):
        electrons = sensor.decision_e * np.array([1.1, 1.5, 1.9])
        rate = electrons / sensor.longest_exposure_s * 2.0**exponent
        exposed = steps.integrate(rate, sensor, np.random.default_rng(exponent))
        assert (exposed.exponent == exponent).all()
    ends = steps.integrate(np.array([0.0, 1e30]), sensor, np.random.default_rng(0))
    assert ends.exponent.tolist() == [0, sensor.steps - 1]
    assert ends.charge[0] == 0


@pytest.mark.parametrize("full_well", [1000.0, 100_000.0])
@pytest.mark.parametrize("share", [0.3, 0.71, 0.99, 1.0, 1.02, 1.4, 3.9])
def test_same_distribution_as_the_step_by_step_reference(full_well: float, share: float) -> None:
    sensor, n = sensor_of(full_well_e=full_well), 20_000
    rate = share * sensor.decision_e / sensor.longest_exposure_s * 16
    fast = steps.integrate(np.full(n, rate), sensor, np.random.default_rng(1))
    exponent, charge = chronological(rate, sensor, n, np.random.default_rng(2))
    for e in np.union1d(exponent, fast.exponent):
        a, b = fast.charge[fast.exponent == e], charge[exponent == e]
        shares = np.array([a.size, b.size]) / n
        assert abs(shares[0] - shares[1]) < 4 * np.sqrt(shares.mean() * (1 - shares.mean()) * 2 / n) + 1e-9
        if min(a.size, b.size) > 50:
            assert stats.ks_2samp(a, b).pvalue > 1e-4


def test_saturation_is_flagged_and_nothing_else_is() -> None:
    sensor = sensor_of()
    top = (sensor.saturation_dn - sensor.offset_dn) * sensor.gain_e_per_dn / sensor.longest_exposure_s * 2048
    for factor, expected in ((1.1, True), (100.0, True), (1e9, True), (0.95, False), (1e-3, False)):
        raw = record(factor * top, sensor, 1000, 7)
        image = to_radiance(raw, sensor, 0)
        assert (image.saturated == expected).all()
        assert np.isfinite(image.radiance).all()
        assert np.isfinite(image.variance).all()
        if expected:
            assert (raw.charge == sensor.saturation_dn).all()
            assert (raw.exponent == sensor.steps - 1).all()
            assert (image.radiance * sensor.responsivity[0] <= 1.001 * top).all()


@pytest.mark.parametrize("full_well", [1000.0, 100_000.0])
def test_only_the_shortest_exposure_can_saturate(full_well: float) -> None:
    """The decision leaves room for noise: a pixel that just goes on does not overflow at the next step."""
    sensor = sensor_of(full_well_e=full_well, read_noise_e=3)
    for exponent in range(1, 11):
        rate = sensor.decision_e / sensor.longest_exposure_s * 2**exponent
        raw = record(rate, sensor, 20_000, exponent)
        assert raw.charge.max() < sensor.saturation_dn


def test_known_record_by_hand() -> None:
    """Exact figures: 164 DN at exponent 3 of a sensor without decision are (164 - 64) * 10 - 100 / 8 electrons."""
    sensor = Sensor(1.0, 4, 8, 10.0, 2.0, 100.0, 64.0, (2.0,))
    raw = RawImage(np.array([[3, 0]], np.uint8), np.array([[164, 255]], np.uint16))
    image = to_radiance(raw, sensor, 0)
    assert image.radiance[0, 0] == pytest.approx((1000 - 12.5) * 8 / 2)
    assert image.variance[0, 0] == pytest.approx((1000 + 4 + 100 / 12) * 16)
    assert image.saturated.tolist() == [[False, True]]


def test_steps_are_named_with_units() -> None:
    rig = TwinRigConfig(cameras=(VIEW,))
    names = [step.name for step in Lars3(lars3_sensor(rig), np.ones((1, 1), np.float32)).steps(0)]
    assert names == [
        "vignetting",
        "photoelectrons",
        "dark signal",
        "shot noise and exposure decision",
        "read noise",
        "quantisation",
    ]
