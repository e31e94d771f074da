"""A camera that does not see the whole object is warned of, with how much of the surface its image lacks."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.plan.visibility import warn_of_frame

FAR = 1e5  # mm: all rays are parallel, and a frame cuts a ball along planes
RADIUS = 20.0


def camera(aim: tuple[float, float, float], wide: float = 100.0, high: float = 100.0, **more: object) -> CameraConfig:
    """From +x far away; the frame is `wide` mm along y and `high` mm along z at the object."""
    position = (FAR, aim[1], aim[2])
    width = 400
    height = round(width * high / wide)
    config = {"name": "far", "position_mm": position, "aim_mm": aim, "width": width, "height": height, **more}
    return CameraConfig.model_validate(config | {"focal_length_mm": FAR * width * 11e-3 / wide, "pixel_pitch_um": 11.0})


def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)


def warned(config: CameraConfig, mesh: trimesh.Trimesh, angles: tuple[float, ...] = (0.0,)) -> str | None:
    return warn_of_frame(config, mesh, "rig.cameras[3]", "the camera 'far'", angles)


def test_a_whole_object_gives_no_warning() -> None:
    assert warned(camera((0, 0, 0)), ball()) is None
    assert warned(camera((0, 0, 0), wide=40.2, high=40.2), ball()) is None


@pytest.mark.parametrize("beyond", [1.0, 5.0, 20.0, 35.0])
def test_the_share_is_that_of_the_cut_cap(beyond: float) -> None:
    """Expected behaviour: of a ball of radius r, a plane cuts off h / 2r of the surface, h high (Archimedes)."""
    line = warned(camera((0, 0, RADIUS - beyond - 50)), ball())
    assert line is not None
    assert "\n" not in line
    share = int(line.split(" deg ")[1].split(" %")[0])
    assert share == pytest.approx(100 * beyond / (2 * RADIUS), abs=1.0)


def test_a_sliver_is_less_than_a_percent() -> None:
    line = warned(camera((0, 0, RADIUS - 0.1 - 50)), ball())
    assert line is not None and "less than 1 % of its surface" in line


def test_the_worst_angle_is_named_with_the_remedy() -> None:
    """Expected behaviour: an egg seen from its end fits the frame; turned by 90 degrees it does not, by 50 nearly."""
    egg = trimesh.Trimesh(ball().vertices * [2.0, 1.0, 1.0], ball().faces, process=False)
    line = warned(camera((0, 0, 0), wide=50.0), egg, tuple(np.deg2rad([0.0, 50.0, 90.0])))
    assert line is not None
    assert line.startswith("the camera 'far' does not see the whole object: at turntable angle 90 deg (and at 1 more) ")
    assert "Remedy: a shorter rig.cameras[3].focal_length_mm, a farther position_mm, or another aim_mm" in line


def test_what_lies_behind_a_camera_is_outside() -> None:
    near = camera((0, 0, 0)).model_copy(update={"position_mm": (10.0, 0.0, 0.0), "focal_length_mm": 1e-3})
    line = warned(near, ball())
    assert line is not None
    share = int(line.split(" deg ")[1].split(" %")[0])
    assert share == pytest.approx(25, abs=2)  # the cap beyond the plane at x = 10
