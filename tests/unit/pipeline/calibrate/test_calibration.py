"""The calibration file: round trip, refusals, frames, photometry."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from hw.base.errors import InputError
from hw.interface import Aim
from hw.record import RawImage, Sensor, to_radiance
from pipeline.calibrate.calibration import Calibration, ScanCalibration, nominal_calibration
from pipeline.geometry.camera import PinholeCamera, turn
from pipeline.geometry.nominal_rig import CameraConfig, RigConfig
from pipeline.geometry.projector import TwoMirrorProjector

RIG = RigConfig(
    cameras=(
        CameraConfig(name="a", position_mm=(400, -120, 190), width=96, height=64, distortion=(-0.1, 0.02, 0, 0, 0)),
        CameraConfig(name="b", position_mm=(-400, 170, -115), width=64, height=48),
    ),
    turntable_angles_deg=(0, 120, 240),
)
SENSOR = Sensor(1 / 30, 12, 12, 25.0, 25.0, 500.0, 64.0, (1e12, 2e12, 3e12))


@pytest.fixture
def calibration() -> Calibration:
    return nominal_calibration(RIG, SENSOR)


def test_views_are_cameras_outermost(calibration: Calibration) -> None:
    assert [(v.camera, round(np.degrees(v.angle_rad))) for v in calibration.views] == [
        (c, a) for c in "ab" for a in (0, 120, 240)
    ]
    assert (len(calibration.views), calibration.n_angles) == (6, 3)
    assert list(calibration.views_at(1)) == [1, 4]


def test_view_cameras_and_spot_rays_are_the_nominal_rig_in_the_object_frame(calibration: Calibration) -> None:
    points = np.random.default_rng(0).uniform(-20, 20, (20, 3))
    for view, config, angle in ((1, RIG.cameras[0], 1), (5, RIG.cameras[1], 2)):
        rotation = turn(np.deg2rad(RIG.turntable_angles_deg[angle]))[:3, :3]
        expected = PinholeCamera.from_config(config).project(points @ rotation.T)[0]
        np.testing.assert_allclose(calibration.view_camera(view).project(points)[0], expected, atol=1e-9)
    aims = [Aim(2, 100, 4000), Aim(0, 2047, 2048), Aim(2, 0, 0)]
    origins, directions = calibration.spot_rays(aims)
    for aim, origin, direction in zip(aims, origins, directions, strict=True):
        rotation = turn(np.deg2rad(RIG.turntable_angles_deg[aim.angle]))[:3, :3]
        o, d = TwoMirrorProjector.from_config(RIG.projector).rays(np.array([[aim.u, aim.v]], float))
        np.testing.assert_allclose(rotation @ origin, o[0], atol=1e-9)
        np.testing.assert_allclose(rotation @ direction, d[0], atol=1e-12)
    assert calibration.spot_rays([])[0].shape == (0, 3)


def test_round_trip_keeps_every_digit(calibration: Calibration, tmp_path: Path) -> None:
    calibration.save(tmp_path / "calibration.json")
    assert Calibration.load(tmp_path / "calibration.json") == calibration


def test_a_scan_is_moved_as_it_was_calibrated(calibration: Calibration) -> None:
    """Along its vertex normals, by vertex; a scan of another number of vertices is refused."""
    ball = trimesh.creation.icosphere(2, 10.0)
    assert calibration.calibrated(ball) is ball
    outward = tuple(0.01 * k for k in range(len(ball.vertices)))
    moved = calibration.model_copy(update={"scan": ScanCalibration(displacement_mm=outward, error_mm=outward)})
    distance = np.linalg.norm(moved.calibrated(ball).vertices, axis=1)
    np.testing.assert_allclose(distance, 10.0 + np.array(outward), atol=1e-3)
    with pytest.raises(InputError, match="another scan"):
        moved.calibrated(trimesh.creation.icosphere(1, 10.0))


def test_refusals_are_one_line_that_names_the_file(calibration: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    with pytest.raises(InputError, match=r"calibration\.json"):
        Calibration.load(path)
    calibration.save(path)
    good = json.loads(path.read_text())
    bad: list[object] = ["{", [], good | {"format_version": 2}, good | {"colour": 1}, good | {"views": []}]
    bad.append(good | {"lasers": [{"wavelength_nm": 635, "power_w": -1}]})
    for content in bad:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        with pytest.raises(InputError, match=r"calibration\.json") as caught:
            Calibration.load(path)
        assert "\n" not in str(caught.value)


def test_vignetting_is_cos4_of_the_angle_to_the_axis_and_is_divided_out(calibration: Calibration) -> None:
    gain, camera = calibration.vignetting(0), calibration.view_camera(0)
    _, rays = camera.rays(np.array([[0.5, 0.5], [48.5, 32.5]]))
    cosine = rays @ camera.pose[2, :3]
    np.testing.assert_allclose([gain[0, 0], gain[32, 48]], cosine**4, rtol=1e-12)
    assert calibration.vignetting(2) is gain  # computed once for the views of a camera
    assert calibration.vignetting(3).shape == (48, 64)
    assert not gain.flags.writeable
    raw = RawImage(np.full((64, 96), 3, np.uint8), np.full((64, 96), 1000, np.uint16))
    plain, corrected = to_radiance(raw, SENSOR, 1), calibration.radiance(raw, 0, 1)
    np.testing.assert_allclose(corrected.radiance * gain, plain.radiance, rtol=1e-6)
    np.testing.assert_allclose(corrected.variance * gain**2, plain.variance, rtol=1e-6)
    assert corrected.radiance.dtype == np.float32
