"""How readings become samples: weights of the cameras, and the noise that is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from reconstruct_capture import ETA, rig
from scipy import sparse

from hw.interface import Aim
from hw.record import RawImage, Sensor
from pipeline.geometry.camera import PinholeCamera
from pipeline.plan.plan import ImageAddress, Plan
from pipeline.reconstruct.samples.image_operators import ImageOperator
from pipeline.reconstruct.samples.laser_samples import LaserSamples
from pipeline.reconstruct.samples.resample import Batch, BatchResult, Sums, ViewReader, _read
from pipeline.reconstruct.samples.samples import ANGULAR, OBLIQUE, Samples, SpotSumImage, _Gathered
from pipeline.reconstruct.samples.spots import Spots


def gathered_twice(noise_front: float, cosine_back: float, share_back: float = 1.0, incidence: float = 1.0) -> Samples:
    """One spot seen by two cameras that disagree by a half; noise_front: relative noise of what the first one says;
    share_back: of the footprints that the second one sees; incidence: cosine.
    """
    value = 1e-3
    plan = Plan(("front", "back"), (0.0,), (Aim(0, 0, 0),), 1)
    mesh = trimesh.creation.icosphere(subdivisions=1)
    size = len(mesh.vertices)
    readings = [
        ImageOperator(sparse.csr_array((size, 1)), np.full(size, share), np.full(size, cosine))
        for share, cosine in ((1.0, 0.9), (share_back, cosine_back))
    ]
    gathered = _Gathered(1, plan, readings)
    gathered.scale[:] = 1.0
    for view, factor in enumerate((1.0, 1.5)):
        variance = (value * noise_front) ** 2 if view == 0 else 1e-20
        gathered.value[0, 0, view] = value * factor
        gathered.noise[0, view] = gathered.shot[0, view] = gathered.dark[0, view] = variance
    up = np.array([[0.0, 0.0, 1.0]])
    way = np.array([[np.sqrt(1 - incidence**2), 0.0, -incidence]])
    spots = Spots(up, way, up, np.array([0]), np.full((1, 3), 1 / 3), np.ones(1), 1.0)
    camera = PinholeCamera.from_config(rig().cameras[0])
    glow = tuple(SpotSumImage(camera, np.zeros((1, 80, 96)), np.ones((1, 1), bool)) for _ in range(2))
    return gathered.combined(mesh, ETA, spots, glow)


def test_cameras_are_merged_by_expected_precision() -> None:
    """Rationale: two readings of 1 and 1.5 weigh by one over noise^2 + scatter between directions^2 + obliqueness^2.
    Expected behaviour: alike, they meet in the middle; noise or a grazing view of one moves the mean to the other by
    just that much, and the variance that is told is that of the weighted mean.
    """
    for noise, cosine, part in ((0.0, 0.9, 1.0), (0.3, 0.9, 1.0), (0.0, 0.2, 0.6), (0.3, 0.2, 0.6)):
        s = gathered_twice(noise, cosine, part)
        expected = 1.25e-3  # both cameras' mean at this distance
        front = (1e-3 * noise / expected) ** 2 + ANGULAR**2 + OBLIQUE**2 * (1 - 0.9) ** 8
        back = ANGULAR**2 + OBLIQUE**2 * (1 - cosine) ** 8
        share = (1 / front) / (1 / front + part / back)
        np.testing.assert_allclose(s.values, 1e-3 * (share + 1.5 * (1 - share)), rtol=1e-5)
        np.testing.assert_allclose(s.dark_variance, (share * 1e-3 * noise) ** 2, rtol=1e-4, atol=1e-19)


def test_obliqueness_of_both_ends_is_told() -> None:
    """Rationale: (.5 (1 - cosine)^4)^2 of the laser's incidence and of the cameras' views by their weight."""
    s = gathered_twice(0.0, 0.9, incidence=0.3)
    np.testing.assert_allclose(s.oblique, 0.25 * (0.7**8 + 0.1**8), rtol=1e-4)
    measured = LaserSamples.of(
        replace(s, dark_variance=0 * s.dark_variance, noise_per_signal=0 * s.noise_per_signal), 0
    )
    np.testing.assert_allclose(measured.variance(np.ones_like(s.oblique)), s.oblique)


def test_tilt_is_that_of_both_ends() -> None:
    """Rationale: written out for one camera far along x and a laser that comes from the side of -x."""
    s = gathered_twice(0.0, 0.9, incidence=0.5)
    eye, points, normals = rig().cameras[0], np.asarray(s.mesh.vertices), np.asarray(s.mesh.vertex_normals)
    position = np.array(eye.position_mm)
    for v in (3, 10, 20):
        way = points[v] - s.spots.position[0]
        way /= np.linalg.norm(way)
        look = (position - points[v]) / np.linalg.norm(position - points[v])
        there = (look - normals[v] * (look @ normals[v])) @ way / s.eta
        down, normal = s.spots.direction[0], s.spots.normal[0]
        here = (down - normal * (down @ normal)) @ way / s.eta
        assert s.tilt[0, v] == pytest.approx(there + here, abs=1e-5)
        assert abs(there) > 0.01 or abs(here) > 0.01


def test_expectation_follows_a_steep_kernel() -> None:
    """Rationale: weights come from what is usual at a distance; R_d falls by decades within a few edges."""
    plan = Plan(("front",), (0.0,), tuple(Aim(0, i, 0) for i in range(100)), 1)
    rng = np.random.default_rng(2)
    distance = rng.uniform(0.05, 30, (100, 500))
    empty = sparse.csr_array((500, 1))
    gathered = _Gathered(1, plan, [ImageOperator(empty, np.ones(500), np.ones(500))])
    gathered.value[0, :, 0] = np.exp(-distance / 1.2)
    ratio = gathered.expected(distance)[0] / np.exp(-distance / 1.2)
    assert np.abs(np.log(ratio[distance < 8])).max() < 0.8
    assert np.abs(np.log(ratio[distance < 8])).mean() < 0.3


def test_noise_is_not_below_the_cameras_own_nor_counted_where_nothing_was_read() -> None:
    """Rationale: images without any scatter: the camera's model speaks. A spot whose readings were blanked (highlight,
    saturation) counts neither with its signal nor with its noise.
    """
    plan = Plan(("front",), (0.0,), tuple(Aim(0, i, 0) for i in range(4)), 1)
    size, shape = 42, (9, 7)
    operator = sparse.csr_array((np.ones(size), (np.arange(size), np.full(size, 31))), shape=(size, 63))
    everything = slice(0, shape[0]), slice(0, shape[1])
    sight = ViewReader(0, everything, {"it": np.arange(size)}, {"it": operator.astype(np.float32)}, np.ones(shape))
    sensor = Sensor(1.0, 1, 4, 1.0, 0.0, 0.0, 0.0, (1.0,))
    table = (np.array([2.0, 2.0, 200.0], np.float32), np.array([0.1, 0.5, 0.5], np.float32))
    part = BatchResult.of(Batch(sight, 0, [ImageAddress(0, "spot", spot, 0) for spot in range(4)]))
    for spot in range(4):
        charge = np.ones(shape, np.uint16)
        charge[4, 3] = 2 if spot == 3 else 1  # scatter that is not to count
        part.scale[spot] = 1.0
        _read(
            part,
            spot,
            RawImage(np.zeros(shape, np.uint8), charge),
            sensor,
            table,
            np.arange(size) if spot == 3 else None,
        )
    assert part.hidden == size
    gathered = _Gathered(1, plan, [ImageOperator(operator, np.ones(size), np.ones(size))])
    gathered.add("it", part)
    gathered.add_noise(sight, "it", 0, part.sums, 0.1)
    np.testing.assert_allclose(gathered.noise_per_signal()[0, :, 0], (0.5 - 0.1) / 2.0, rtol=1e-3)


def test_noise_of_dark_samples_is_told_truly() -> None:
    """Rationale: images of nothing but noise. The stated variance is that of the samples, not a clipped-up one."""
    plan = Plan(("front",), (0.0,), tuple(Aim(0, i, 0) for i in range(200)), 1)
    rng, sigma = np.random.default_rng(5), 1e-3
    mesh = trimesh.creation.icosphere(subdivisions=1)
    size, shape = len(mesh.vertices), (40, 40)
    pixel = rng.permutation(shape[0] * shape[1])[: 4 * size].reshape(size, 4)
    rows = np.repeat(np.arange(size), 4)
    operator = sparse.csr_array((np.full(4 * size, 0.25), (rows, pixel.ravel())), shape=(size, shape[0] * shape[1]))
    everything = slice(0, shape[0]), slice(0, shape[1])
    sight = ViewReader(0, everything, {"it": np.arange(size)}, {"it": operator}, np.ones(shape))
    gathered = _Gathered(1, plan, [ImageOperator(operator, np.ones(size), np.ones(size))])
    sums = Sums.zeros(shape)
    for spot in range(200):
        radiance = 0.1 * sigma + sigma * rng.standard_normal(shape)
        gathered.value[0, spot, 0] = operator @ radiance.ravel()
        sums.add(radiance, np.full(shape, 1e-3 * sigma**2))
    gathered.scale[:] = 1.0
    gathered.add_noise(sight, "it", 0, sums, 1e-3 * sigma**2)
    told = gathered.noise_per_signal()[0, :, 0] * np.maximum(gathered.value[0, :, 0], 0)
    actual = gathered.value[0, :, 0].var(axis=0).mean()
    assert told.mean() == pytest.approx(actual, rel=0.1)
