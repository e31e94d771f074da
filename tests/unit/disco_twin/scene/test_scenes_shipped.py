"""The scenes that ship: they load, build, and are what the README says they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from disco_twin.object.build import build_object, build_scan
from disco_twin.scene.scene import Scene, load_scene
from pipeline.geometry.camera import PinholeCamera, turn
from pipeline.geometry.nominal_rig import CameraConfig


@pytest.fixture(scope="module")
def quick(repository: Path) -> Scene:
    return load_scene(repository / "scenes" / "quick.toml")


def test_every_scene_builds(repository: Path) -> None:
    paths = sorted((repository / "scenes").glob("*.toml"))
    assert {"quick", "slab"} <= {path.stem for path in paths}
    for path in paths:
        scene = load_scene(path)
        assert scene.name == path.stem
        built = build_object(scene)
        assert built.mesh.is_watertight
        assert len(built.medium.sigma_t) == len(built.medium.g) == len(scene.rig.lasers)


def test_quick_is_as_large_as_promised(quick: Scene) -> None:
    built = build_object(quick)
    scan = build_scan(quick, built.mesh)
    assert len(quick.rig.lasers) == 3
    assert len(quick.rig.cameras) * len(quick.rig.turntable_angles_deg) == 6
    assert quick.rig.spots == 300
    assert all(c.width >= 192 and c.height >= 124 for c in (*quick.rig.cameras, *quick.relight.views))
    assert len(scan.vertices) >= 500
    assert scan.is_watertight
    assert built.medium.sigma_t.std() > 0.1 * built.medium.sigma_t.mean()  # heterogeneous


def test_quick_needs_one_walk_for_three_wavelengths(quick: Scene) -> None:
    medium = build_object(quick).medium
    assert np.ptp(medium.sigma_t, axis=0).max() < 1e-6
    assert np.ptp(medium.albedo, axis=0).max() > 0.1


def test_quick_fills_its_images(quick: Scene) -> None:
    vertices = np.array(build_object(quick).mesh.vertices)

    def extent(camera: CameraConfig, angle_deg: float) -> tuple[float, float]:
        """Smallest margin to the image's border and height of the object, in pixels."""
        seen = PinholeCamera.from_config(camera).seen_from(turn(np.deg2rad(angle_deg)))
        pixels, depth = seen.project(vertices)
        assert depth.min() > 350
        assert depth.max() < 550
        margin = min(pixels.min(), (np.array([camera.width, camera.height]) - pixels).min())
        return float(margin), float(np.ptp(pixels[:, 1]))

    for camera in (*quick.rig.cameras, *quick.relight.views):
        for angle in quick.rig.turntable_angles_deg:
            margin, height = extent(camera, angle)
            assert margin > 2
            assert height > 0.7 * camera.height


def test_small_profile_keeps_field_of_view_and_object(quick: Scene, repository: Path) -> None:
    small = load_scene(repository / "scenes" / "quick.toml", profile="small")
    assert small.object == quick.object
    assert small.rig.spots == 75
    assert small.simulation.walks_per_spot == quick.simulation.walks_per_spot // 10
    for a, b in zip(quick.rig.cameras, small.rig.cameras, strict=True):
        assert b.width * b.height * 4 == a.width * a.height
        assert b.width * b.pixel_pitch_um == pytest.approx(a.width * a.pixel_pitch_um)
    Scene.model_validate(small.model_dump())
