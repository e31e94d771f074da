"""The scenes that ship: they load, build, and are what the README says they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from disco_twin.object.build import TwinObject, build_object, build_scan
from disco_twin.scene.scene import Scene, load_scene
from pipeline.geometry.camera import PinholeCamera, turn
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.plan.plan import make_plan


@pytest.fixture(scope="module")
def quick(repository: Path) -> Scene:
    return load_scene(repository / "scenes" / "quick.toml")


@pytest.fixture(scope="module")
def quick_object(quick: Scene) -> TwinObject:
    return build_object(quick)


def test_every_scene_builds(repository: Path) -> None:
    paths = sorted((repository / "scenes").glob("*.toml"))
    assert {"quick", "slab"} <= {path.stem for path in paths}
    for path in paths:
        scene = load_scene(path)
        assert scene.name == path.stem
        built = build_object(scene)
        assert built.mesh.is_watertight
        assert len(built.medium.sigma_t) == len(built.medium.g) == len(scene.rig.lasers)


def test_quick_is_as_large_as_promised(quick: Scene, quick_object: TwinObject) -> None:
    built = quick_object
    scan = build_scan(quick, built.mesh)
    assert len(quick.rig.lasers) == 3
    assert len(quick.rig.cameras) * len(quick.rig.turntable_angles_deg) == 6
    assert quick.rig.spots == 300
    assert all(c.width >= 192 and c.height >= 124 for c in (*quick.rig.cameras, *quick.relight.views))
    assert len(scan.vertices) >= 500
    assert scan.is_watertight
    assert built.medium.sigma_t.std() > 0.1 * built.medium.sigma_t.mean()  # heterogeneous


def test_quick_needs_one_walk_for_three_wavelengths(quick_object: TwinObject) -> None:
    medium = quick_object.medium
    assert np.ptp(medium.sigma_t, axis=0).max() < 1e-6
    assert np.ptp(medium.albedo, axis=0).max() > 0.1


def test_quick_fills_its_images(quick: Scene, quick_object: TwinObject) -> None:
    vertices = np.array(quick_object.mesh.vertices)

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


# The accuracy set --------------------------------------------------------------------------------------------------

CHOOSE, SCORE = {"ring", "figure", "animal"}, {"bracket", "flower", "gourd", "newt"}
BEYOND_THE_FRAME = "newt"


@pytest.fixture(scope="module")
def accuracy_set(repository: Path) -> dict[str, Scene]:
    return {path.stem: load_scene(path) for path in sorted((repository / "scenes" / "accuracy").glob("*/*.toml"))}


@pytest.fixture(scope="module")
def accuracy_objects(accuracy_set: dict[str, Scene]) -> dict[str, TwinObject]:
    return {name: build_object(scene) for name, scene in accuracy_set.items()}


def test_the_accuracy_set_shares_no_object(repository: Path, accuracy_set: dict[str, Scene]) -> None:
    for folder, names in (("choose", CHOOSE), ("score", SCORE)):
        assert {path.stem for path in (repository / "scenes" / "accuracy" / folder).glob("*.toml")} == names
    assert all(scene.name == name for name, scene in accuracy_set.items())
    assert len({scene.seed for scene in accuracy_set.values()}) == len(accuracy_set)  # no two rigs err alike
    shapes = {scene.object.shape.model_dump_json() for scene in accuracy_set.values()}
    media = {scene.object.medium.model_dump_json() for scene in accuracy_set.values()}
    assert len(shapes) == len(media) == len(accuracy_set)


def test_the_accuracy_set_is_measured_alike(accuracy_set: dict[str, Scene], quick: Scene) -> None:
    """The same rig with all its faults, the same lights and views, as many columns of truth as totals need."""
    for scene in accuracy_set.values():
        assert scene.rig == quick.rig
        assert all(scene.rig.faults.model_dump().values())
        assert (scene.relight.views, scene.relight.lights) == (quick.relight.views, quick.relight.lights)
        assert scene.simulation.truth_columns == 48


def test_the_accuracy_set_spans_what_is_measured(
    accuracy_set: dict[str, Scene], accuracy_objects: dict[str, TwinObject]
) -> None:
    """Indices, roughness, asymmetry, and sizes in transport mean free paths (of the ball of the same volume)."""
    eta = [scene.object.boundary.eta for scene in accuracy_set.values()]
    alpha = [scene.object.boundary.alpha for scene in accuracy_set.values()]
    g = [scene.object.medium.g for scene in accuracy_set.values()]
    assert (min(eta), max(eta), min(alpha), max(alpha), min(g), max(g)) == (1.3, 1.6, 0.05, 0.4, 0.0, 0.8)
    size = {}
    for name, scene in accuracy_set.items():
        mesh, base = accuracy_objects[name].mesh, scene.object.medium.base
        assert base.kind == "homogeneous"
        radius = (3 * mesh.volume / (4 * np.pi)) ** (1 / 3)
        size[name] = radius * float(np.max(base.sigma_t_per_mm)) * (1 - float(np.max(scene.object.medium.g)))
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
        assert 15_000 < len(mesh.faces) < 20_000
        assert mesh.euler_number == (0 if name in ("ring", "bracket") else 2)
    assert 7.5 < min(size.values()) < 9
    assert 55 < max(size.values()) < 65
    features = {name: bool(scene.object.medium.features) for name, scene in accuracy_set.items()}
    assert {name for name, has in features.items() if not has} == {"ring", "bracket", "flower"}


def test_the_accuracy_set_can_be_captured(
    accuracy_set: dict[str, Scene], accuracy_objects: dict[str, TwinObject]
) -> None:
    """Every object is planned on its own mesh, and fits all images with a margin; one is longer than most of them."""
    for name, scene in accuracy_set.items():
        mesh = accuracy_objects[name].mesh
        assert len(make_plan(scene.rig, mesh).spots) == 300
        margins = []
        for camera, angle in [(c, a) for c in scene.rig.cameras for a in scene.rig.turntable_angles_deg] + [
            (view, 0.0) for view in scene.relight.views
        ]:
            pixels, _ = PinholeCamera.from_config(camera).seen_from(turn(np.deg2rad(angle))).project(mesh.vertices)
            margins.append(min(pixels.min(), (np.array([camera.width, camera.height]) - pixels).min()))
        assert (min(margins) < -10) if name == BEYOND_THE_FRAME else (min(margins) > 1), (name, margins)


def test_necks_are_stated_where_objects_are_thinnest(
    accuracy_set: dict[str, Scene], accuracy_objects: dict[str, TwinObject]
) -> None:
    assert {name for name, scene in accuracy_set.items() if scene.relight.neck} == {"figure", "gourd"}
    for name in ("figure", "gourd"):
        neck, mesh = accuracy_set[name].relight.neck, accuracy_objects[name].mesh
        assert neck is not None
        normal = np.array(neck.normal) / np.linalg.norm(neck.normal)
        around = []
        for height in (-4.0, 0.0, 4.0):
            cut = mesh.section(plane_origin=np.array(neck.through_mm) + height * normal, plane_normal=normal)
            assert len(cut.entities) == 1
            around.append(cut.length)
        assert around[1] < 0.65 * min(around[0], around[2]), (name, around)
