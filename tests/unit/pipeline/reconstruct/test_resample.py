"""The fast way from records to readings against the plain one in double precision, on records of all kinds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from reconstruct_capture import ETA, RADIUS, SENSOR, rig
from scipy import ndimage

from hw.base.errors import DiscoError
from hw.record import RawImage
from pipeline.calibrate.calibration import Calibration, nominal_calibration
from pipeline.plan.plan import make_plan
from pipeline.reconstruct.samples.image_operators import ImageOperator, bilinear_reading, footprint_reading
from pipeline.reconstruct.samples.resample import Sums, ViewReader, resample
from pipeline.stream.stream import ImageMeta, StreamReader, StreamWriter

SHAPE = (80, 96)
MASK = np.outer([1, -2, 1], [1, -2, 1]) / 6.0


def noise_squared(image: np.ndarray) -> np.ndarray:
    """Immerkaer's estimate of each pixel's noise variance."""
    return np.asarray(ndimage.convolve(image, MASK, mode="nearest") ** 2)


def record(index: int) -> RawImage:
    """A record with all exponents and charges side by side, and a saturated pixel in every fifth."""
    rng = np.random.default_rng(index)
    charge = rng.integers(60, 4000, SHAPE, dtype=np.uint16)
    if index % 5 == 0:
        charge[40, 48] = SENSOR.saturation_dn
    return RawImage(rng.integers(0, SENSOR.steps, SHAPE, dtype=np.uint8), charge)


def power(index: int) -> float:
    return 0.0 if index % 29 == 3 else 0.01 * (1 + index % 7)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, trimesh.Trimesh, Calibration]:
    folder = tmp_path_factory.mktemp("capture")
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=RADIUS)
    mesh.apply_translation([0.0, 0.0, 6.0])  # the cameras see it up to the image's upper border
    plan = make_plan(rig(), mesh)
    with StreamWriter(folder, plan) as stream:
        for index, address in enumerate(plan.addresses()):
            stream.append(address, record(index), ImageMeta(0.0, power(index), 0.0, 0, 0))
    plain = nominal_calibration(rig(), SENSOR)
    views = [
        v.model_copy(update={"radiance_factor": (1.2 + 0.1 * k, 0.9 - 0.1 * k)}) for k, v in enumerate(plain.views)
    ]
    return folder, mesh, plain.model_copy(update={"views": tuple(views)})


def readings_of(mesh: trimesh.Trimesh, calibration: Calibration, view: int) -> dict[str, ImageOperator]:
    camera = calibration.view_camera(view)
    samplings = {"footprint": footprint_reading, "bilinear": bilinear_reading}
    return {sampling: reading(mesh, camera, ETA, 75.0) for sampling, reading in samplings.items()}


def test_equals_the_plain_computation(capture: tuple[Path, trimesh.Trimesh, Calibration]) -> None:
    """Rationale: values, noise, shot noise and glow from whole images in double precision, image by image.
    Expected behaviour: equal to single precision, white balance included; what is saturated or hidden counts nowhere,
    nor do unlit images.
    """
    folder, mesh, calibration = capture
    with StreamReader(folder) as stream:
        plan = stream.plan
        transmitted = np.where(np.arange(len(plan.spots)) % 6 == 1, 0.0, 0.9 - 0.01 * np.arange(len(plan.spots)))
        hidden = {(v, s): np.arange(s, 160, 3) for v in range(plan.views) for s in range(0, len(plan.spots), 4)}
        samplings = [readings_of(mesh, calibration, view) for view in range(plan.views)]
        readers = [ViewReader.of(view, calibration, mesh, samplings[view]) for view in range(plan.views)]
        results = list(resample(stream, calibration, readers, transmitted, hidden))
    assert {a.spot for p in results for a in p.batch.addresses} == set(np.flatnonzero(transmitted).tolist())
    border = np.pad(np.zeros((SHAPE[0] - 2, SHAPE[1] - 2)), 1, constant_values=1.0).ravel()
    blank = 0
    for result in results:
        reader = result.batch.reader
        glow = np.zeros(SHAPE)
        noise = {sampling: np.zeros((2, len(rows))) for sampling, rows in reader.rows.items()}
        for i, address in enumerate(result.batch.addresses):
            index = plan.index(address)
            assert (address in result.lost) == (result.scale[i] == 0.0) == (power(index) == 0.0)
            if power(index) == 0.0:
                assert all(np.isnan(result.value[sampling][i]).all() for sampling in result.value)
                continue
            image = calibration.radiance(record(index), reader.view, result.batch.laser)
            scale = np.pi / (transmitted[address.spot] * power(index))
            assert result.scale[i] == pytest.approx(scale * calibration.factor(reader.view, result.batch.laser))
            radiance, shot = image.radiance.astype(np.float64) * scale, image.variance.ravel() * scale**2
            glow += radiance
            for sampling, rows in reader.rows.items():
                operator = samplings[reader.view][sampling].operator[rows]
                unread = abs(operator) @ image.saturated.ravel().astype(float) > 0
                unread |= np.isin(rows, hidden.get((reader.view, address.spot), []))
                assert np.array_equal(np.isnan(result.value[sampling][i]), unread)
                blank += int(unread.sum())
                close = 3e-6 * (abs(operator) @ abs(radiance).ravel())
                assert (abs(result.value[sampling][i] - operator @ radiance.ravel())[~unread] <= close[~unread]).all()
                squared = operator.multiply(operator)
                noise[sampling] += ~unread * [squared @ noise_squared(radiance).ravel(), squared @ shot]
        np.testing.assert_allclose(
            result.sums.glow * reader.gain, glow[reader.window], rtol=1e-5, atol=1e-6 * glow.max()
        )
        for sampling, operator in reader.operators.items():
            squared = operator.multiply(operator)
            np.testing.assert_allclose(
                squared @ result.sums.shot.ravel() + result.alone[sampling][1], noise[sampling][1], rtol=1e-5
            )
            fast = squared @ result.sums.noise_variance().ravel() + result.alone[sampling][0]
            # At the image's border the plain mask sees a pixel twice; the fast way takes the next pixel's estimate.
            inside = samplings[reader.view][sampling].operator[reader.rows[sampling]] @ border == 0
            assert 10 < inside.sum() <= len(fast)
            # The lens's gain is applied after the differences, not before: it is not quite constant over three pixels.
            np.testing.assert_allclose(fast[inside], noise[sampling][0][inside], rtol=2e-3)
    assert blank > 100
    read = [plan.index(a) for p in results for a in p.batch.addresses if power(plan.index(a)) > 0]
    assert sum(result.saturated for result in results) == sum(index % 5 == 0 for index in read)
    assert 0 < sum(result.hidden for result in results) < blank
    assert any(result.lost for result in results)


def test_reading_leaves_the_operators_alone(capture: tuple[Path, trimesh.Trimesh, Calibration]) -> None:
    """Rationale: threads share them, and scipy sorts indices in place where a record is saturated.
    Expected behaviour: the same arrays afterwards, to the bit.
    """
    folder, mesh, calibration = capture
    with StreamReader(folder) as stream:
        readers = [ViewReader.of(v, calibration, mesh, readings_of(mesh, calibration, v)) for v in range(2)]
        kept = [(o.indices.copy(), o.data.copy(), o) for reader in readers for o in reader.operators.values()]
        results = list(resample(stream, calibration, readers, np.ones(len(stream.plan.spots)), {}))
    assert sum(result.saturated for result in results)
    assert all(np.array_equal(i, o.indices) and np.array_equal(d, o.data) for i, d, o in kept)


def test_a_record_that_does_not_fit_the_sensor_is_refused(
    capture: tuple[Path, trimesh.Trimesh, Calibration], tmp_path: Path
) -> None:
    folder, mesh, calibration = capture
    ten_bits = calibration.model_copy(update={"sensor": SENSOR.__class__(**{**vars(SENSOR), "bits": 10})})
    reader = ViewReader.of(0, calibration, mesh, readings_of(mesh, calibration, 0))
    with StreamReader(folder) as stream, pytest.raises(DiscoError, match="do not fit the sensor"):
        list(resample(stream, ten_bits, [reader], np.ones(len(stream.plan.spots)), {}))


def test_noise_estimate_is_unbiased_and_blind_to_slopes() -> None:
    """Outside truth: the mean of estimates over images is the variance that was put in; a ramp adds nothing."""
    rng = np.random.default_rng(0)
    ramp = np.add.outer(np.arange(200.0), 3 * np.arange(200.0))
    sums = Sums.zeros(ramp.shape)
    sums.add(ramp, ramp)
    assert sums.noise_variance().max() < 1e-12
    sums.add(ramp + 2.0 * rng.standard_normal(ramp.shape), ramp)
    measured = sums.noise_variance()
    # 36 neighbours share pixels: the mean's deviation is about that of a ninth of the pixels
    z = (measured.mean() - 4.0) / (4.0 * np.sqrt(2 / (measured.size / 9)))
    assert abs(z) < 4
