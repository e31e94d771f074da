"""Camera and projector geometry against hand-made truths; frames, signs, round trips."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hw.base.config import check
from hw.base.errors import InputError
from pipeline.geometry.camera import PinholeCamera, look_at, turn
from pipeline.geometry.nominal_rig import CameraConfig, ProjectorConfig
from pipeline.geometry.projector import TwoMirrorProjector
from pipeline.relight.lights import TexturedProjector

DISTORTION = (-0.18, 0.09, 0.002, -0.001, 0.03)


def camera(**changes: object) -> PinholeCamera:
    config = CameraConfig.model_validate(
        {"name": "c", "position_mm": (400.0, -100.0, 150.0), "distortion": DISTORTION} | changes
    )
    return PinholeCamera.from_config(config)


def test_a_camera_on_the_x_axis_sees_y_to_the_right_and_z_up() -> None:
    cam = camera(position_mm=(500.0, 0.0, 0.0), distortion=(0.0,) * 5)
    pixels, depth = cam.project(np.array([[0.0, 0, 0], [0, 10, 0], [0, 0, 10.0]]))
    focal = 25.0 / 0.011
    np.testing.assert_allclose(depth, 500)
    np.testing.assert_allclose(pixels[0], [384, 248])
    np.testing.assert_allclose(pixels[1], [384 + focal * 10 / 500, 248])
    np.testing.assert_allclose(pixels[2], [384, 248 - focal * 10 / 500])


def test_turning_is_counter_clockwise_from_above() -> None:
    np.testing.assert_allclose(turn(np.pi / 2) @ [1, 0, 0, 1], [0, 1, 0, 1], atol=1e-15)


def test_look_at_is_a_rotation_with_its_axis_on_the_aim() -> None:
    pose = look_at((3.0, -4, 5), (1.0, 1, 1))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-15)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(pose @ [3, -4, 5, 1], [0, 0, 0, 1], atol=1e-14)
    np.testing.assert_allclose((pose @ [1, 1, 1, 1])[:2], 0, atol=1e-14)
    assert (pose @ [1, 1, 1, 1])[2] > 0


@pytest.mark.parametrize(
    ("position", "up", "image_up"),
    [
        ((0, 0, 9), (0, 0, 1), (0, 1, 0)),
        ((0, 0, -9), (0, 0, 1), (0, 1, 0)),
        ((0, 9, 0), (0, 2, 0), (1, 0, 0)),
        ((9, 0, 0), (1, 0, 0), (0, 1, 0)),
        ((9, 0, 0), (0, 0, 0), (0, 1, 0)),
    ],
)
def test_looking_along_up_takes_another_axis(
    position: tuple[float, ...], up: tuple[float, ...], image_up: tuple[float, ...]
) -> None:
    pose = look_at(position, (0, 0, 0), up)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-15)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(pose[:3, :3] @ image_up, [0, -1, 0], atol=1e-15)


def test_nothing_looks_at_its_own_place() -> None:
    with pytest.raises(InputError, match="Remedy: aim"):
        look_at((1, 2, 3), (1, 2, 3))
    here = {"position_mm": (1.0, 2.0, 3.0), "aim_mm": (1.0, 2.0, 3.0)}
    for schema in (CameraConfig, ProjectorConfig, TexturedProjector):
        name = {} if schema is ProjectorConfig else {"name": "c"}
        with pytest.raises(InputError, match="position_mm equals aim_mm"):
            check(here | name, schema, "scene.toml")


def test_distortion_is_opencvs_by_hand() -> None:
    # x = .2, y = -.1, r2 = .05; radial and tangential terms written out.
    k1, k2, p1, p2, k3 = DISTORTION
    radial = 1 + k1 * 0.05 + k2 * 0.0025 + k3 * 0.000125
    x = 0.2 * radial + 2 * p1 * -0.02 + p2 * (0.05 + 2 * 0.04)
    y = -0.1 * radial + p1 * (0.05 + 2 * 0.01) + 2 * p2 * -0.02
    np.testing.assert_allclose(camera().distort(np.array([[0.2, -0.1]])), [[x, y]], rtol=1e-14)


def test_project_and_rays_are_inverse_with_strong_distortion() -> None:
    cam = camera(focal_length_mm=8.0)
    pixels = np.random.default_rng(0).uniform([0, 0], [768, 496], (200, 2))
    origins, directions = cam.rays(pixels)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    again, depth = cam.project(origins + 321.0 * directions)
    np.testing.assert_allclose(again, pixels, atol=1e-9)
    assert (depth > 0).all()


def test_pixel_centres_run_row_by_row_at_halves() -> None:
    cam = camera(width=20, height=16)
    np.testing.assert_array_equal(cam.pixel_centres()[:2], [[0.5, 0.5], [1.5, 0.5]])
    fine = cam.pixel_centres(2)
    assert len(fine) == 4 * 20 * 16
    np.testing.assert_array_equal(fine[[0, 1, 40]], [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75]])


def test_a_turned_camera_sees_the_object_where_the_still_one_sees_the_turned_object() -> None:
    cam, points = camera(), np.random.default_rng(1).normal(0, 20, (30, 3))
    world = points @ turn(0.7)[:3, :3].T
    np.testing.assert_allclose(cam.seen_from(turn(0.7)).project(points)[0], cam.project(world)[0], atol=1e-9)


def projector(separation: float = 12.0) -> TwoMirrorProjector:
    return TwoMirrorProjector.from_config(
        ProjectorConfig(position_mm=(590.0, 60, 110), full_angle_deg=6, separation_mm=separation)
    )


@pytest.mark.parametrize("separation", [0.0, 12.0])
def test_projector_steps_hit_the_points_they_were_computed_for(separation: float) -> None:
    points = np.random.default_rng(2).uniform(-20, 20, (100, 3))
    p = projector(separation).seen_from(turn(2.0))
    steps = p.steps_to(points)
    origins, directions = p.rays(steps)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    np.testing.assert_allclose(np.cross(points - origins, directions), 0, atol=1e-9)
    assert (((points - origins) * directions).sum(axis=1) > 0).all()


def test_a_projector_without_separation_is_a_pinhole() -> None:
    p = projector(0.0)
    origins, _ = p.rays(np.array([[0.0, 0], [4095, 4095], [17, 2000]]))
    np.testing.assert_allclose(origins, [[590, 60, 110]] * 3, atol=1e-10)


def test_two_mirrors_by_tracing_them() -> None:
    """Rationale: reflect a ray at two real mirrors and compare. The first mirror lies at distance e before the second
    along the unfolded axis. Expected: the same line as the closed form, for any pair of angles.

    Folded path: light arrives along -x... each mirror turns about an axis across the other's; a mirror turned by
    half the optical angle deflects by the optical angle, which in the unfolded picture is a rotation of the ray about
    the mirror's pivot. Rotations are applied here with matrices, not with the closed form's tangents.
    """
    p = replace(projector(12.0), pose=np.eye(4))
    tx, ty = p.angles(np.array([[300.0, 3500.0]]))[0]
    first = np.array([[np.cos(tx), 0, np.sin(tx)], [0, 1, 0], [-np.sin(tx), 0, np.cos(tx)]])
    start, direction = np.array([0.0, 0, -12.0]), first @ [0.0, 0, 1]
    pivot = start + direction * 12.0 / direction[2]  # where it meets the second mirror's axis, the line y = z = 0
    second = np.array([[1, 0, 0], [0, np.cos(ty), np.sin(ty)], [0, -np.sin(ty), np.cos(ty)]])
    origins, directions = p.rays(np.array([[300.0, 3500.0]]))
    np.testing.assert_allclose(origins[0], pivot, atol=1e-12)
    np.testing.assert_allclose(directions[0], second @ direction, atol=1e-12)


def test_projector_centre_and_span() -> None:
    p = projector(0.0)
    middle = (p.steps - 1) / 2
    _, directions = p.rays(np.array([[middle, middle], [0.0, middle], [p.steps - 1, middle]]))
    aim = -np.array([590.0, 60, 110])
    np.testing.assert_allclose(directions[0], aim / np.linalg.norm(aim), atol=1e-12)
    assert np.degrees(np.arccos(directions[1] @ directions[2])) == pytest.approx(6)


def test_points_far_outside_do_not_fold_back_into_the_picture() -> None:
    """Rationale: r (1 - .3 r^2) turns back at r = 1.05; 61 degrees off the axis it lands inside the picture again."""
    config = CameraConfig(
        name="wide", position_mm=(0.0, -500.0, 0.0), width=192, height=124, focal_length_mm=60.0, pixel_pitch_um=44.0,
        distortion=(-0.3, 0.0, 0.0, 0.0, 0.0),
    )  # fmt: skip
    camera = PinholeCamera.from_config(config)
    local = np.array([[0.01, 0.005, 1.0], [np.tan(np.deg2rad(61.0)), 0.0, 1.0]])
    points = (local * 300 - camera.pose[:3, 3]) @ camera.pose[:3, :3]
    pixels, _ = camera.project(points)
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1]).all()
