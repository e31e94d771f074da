"""The lens: vignetting against its formula, glare against a brute-force sum."""

from __future__ import annotations

import numpy as np
import pytest

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.camera.lens import GLARE_SHARE, Glare, vignetting
from disco_twin.scene.rig_schema import TwinRigConfig
from pipeline.calibrate.calibration import nominal_calibration
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.nominal_rig import CameraConfig


def test_vignetting_is_cos4_of_the_angle_to_the_axis() -> None:
    """With f = 20 mm a pixel centre at x mm off the axis is seen at atan(x / 20)."""
    config = CameraConfig(
        name="a", position_mm=(500, 0, 0), width=31, height=21, focal_length_mm=20, pixel_pitch_um=400
    )
    gain = vignetting(PinholeCamera.from_config(config))
    assert gain.shape == (21, 31)
    assert gain[10, 15] == 1.0
    assert gain[0, 0] == pytest.approx((1 + (15 * 0.4 / 20) ** 2 + (10 * 0.4 / 20) ** 2) ** -2, rel=1e-6)
    assert np.allclose(gain, gain[::-1, ::-1], rtol=1e-6)


def test_the_nominal_calibration_knows_this_vignetting() -> None:
    distortion = (0.05, 0.0, 0.001, 0.0, 0.0)
    camera = CameraConfig(name="a", position_mm=(300, 50, 20), width=64, height=40, distortion=distortion)
    rig = TwinRigConfig(cameras=(camera,))
    told = nominal_calibration(rig, lars3_sensor(rig)).vignetting(0)
    assert np.allclose(told, vignetting(PinholeCamera.from_config(camera)), rtol=1e-6)


def test_glare_against_a_direct_sum() -> None:
    height, width = 7, 9
    image = np.random.default_rng(0).exponential(1.0, (height, width)).astype(np.float32)
    y, x = np.mgrid[-6:7, -8:9]
    halo = (1 + (x**2 + y**2) / (width / 64) ** 2) ** -1.5
    spread = GLARE_SHARE * (0.5 * halo / halo.sum() + 0.5 / halo.size)
    expected = (1 - GLARE_SHARE) * image.astype(np.float64)
    for r in range(height):
        for c in range(width):
            for i in range(height):
                for j in range(width):
                    expected[r, c] += spread[r - i + 6, c - j + 8] * image[i, j]
    assert np.allclose(Glare.of(height, width)(image), expected, rtol=1e-5)


def test_glare_keeps_or_loses_light_but_adds_none() -> None:
    image = np.zeros((124, 192), np.float32)
    image[62, 96] = 1.0
    out = Glare.of(124, 192)(image)
    assert (out > 0).all()
    assert out[62, 96] >= 1 - GLARE_SHARE
    assert 1 - GLARE_SHARE < out.sum(dtype=np.float64) <= 1.0
    assert (Glare.of(124, 192)(np.zeros_like(image)) == 0).all()
