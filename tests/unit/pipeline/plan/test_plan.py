"""The plan: addresses, files, and where the spots go."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from capture_fakes import small_plan
from scipy.spatial import cKDTree

from hw.base.errors import InputError
from hw.interface import Aim
from pipeline.geometry.camera import turn
from pipeline.geometry.nominal_rig import CameraConfig, ProjectorConfig, RigConfig
from pipeline.geometry.projector import TwoMirrorProjector
from pipeline.plan.plan import ImageAddress, Plan, load_plan, make_plan
from pipeline.plan.spots import farthest_points

CAMERA = CameraConfig(name="front", position_mm=(450, 60, 100), width=192, height=124, focal_length_mm=10)


def ball(radius: float = 20.0) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=3, radius=radius)


def test_order_is_the_thesis_one() -> None:
    """Fig. 4.1: per camera and angle the silhouette, then every spot in every laser; written out by hand."""
    plan = Plan(("a", "b"), (0.0, 1.0), (Aim(0, 5, 6), Aim(1, 7, 8)), lasers=2)
    spot = [[ImageAddress(v, "spot", v % 2, laser) for laser in (0, 1)] for v in range(4)]
    expected = [a for v in range(4) for a in (ImageAddress(v, "silhouette"), *spot[v])]
    assert list(plan.addresses()) == expected
    assert len(plan) == 12
    assert [plan.camera_of(v) for v in range(4)] == [0, 0, 1, 1]
    assert [plan.angle_of(v) for v in range(4)] == [0, 1, 0, 1]


@pytest.mark.parametrize("spots", [(3, 0, 4), (0,), (1,), (0, 0, 2), (5, 0, 0)])
def test_address_and_index_are_inverse(spots: tuple[int, ...]) -> None:
    plan = small_plan(spots)
    assert [plan.index(plan.address(i)) for i in range(len(plan))] == list(range(len(plan)))
    assert len(plan) == 2 * (len(spots) + 3 * sum(spots))


@pytest.mark.parametrize(
    "address",
    [
        ImageAddress(6, "silhouette"),
        ImageAddress(-1, "silhouette"),
        ImageAddress(0, "spot", 3, 0),
        ImageAddress(0, "spot", 0, 3),
        ImageAddress(1, "spot", 0, 0),
    ],
)
def test_addresses_outside_the_plan_are_refused(address: ImageAddress) -> None:
    with pytest.raises(IndexError):
        small_plan().index(address)


@pytest.mark.parametrize("index", [-1, 48])
def test_indices_outside_the_plan_are_refused(index: int) -> None:
    with pytest.raises(IndexError):
        small_plan().address(index)


def test_spots_must_be_grouped_by_angle() -> None:
    with pytest.raises(ValueError, match="grouped"):
        Plan(("a",), (0.0, 1.0), (Aim(1, 0, 0), Aim(0, 0, 0)), 1)


def test_file_round_trip(tmp_path: Path) -> None:
    plan = small_plan()
    path = tmp_path / "plan.json"
    path.write_text(plan.to_json())
    assert load_plan(path) == plan
    assert load_plan(path).digest == plan.digest
    assert load_plan(path).digest != small_plan((3, 1, 4)).digest


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"format_version": 2}',
        '{"format_version": 1}',
        '{"format_version":1,"cameras":["a"],"angles_rad":[0],"lasers":0,"spots":[]}',
        '{"format_version":1,"cameras":["a"],"angles_rad":[0],"lasers":1,"spots":[[1,0,0]]}',
        '{"format_version":1,"cameras":["a"],"angles_rad":[NaN],"lasers":1,"spots":[]}',
        '{"format_version":1,"cameras":["a"],"angles_rad":[0],"lasers":1,"spots":[],"more":1}',
    ],
)
def test_bad_files_are_one_line_errors(tmp_path: Path, text: str) -> None:
    path = tmp_path / "plan.json"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_plan(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file_and_bytes_that_are_no_text(tmp_path: Path) -> None:
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    for name in ("none.json", "binary.json"):
        with pytest.raises(InputError):
            load_plan(tmp_path / name)


def test_version_is_checked_before_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    path.write_text(json.dumps({**json.loads(small_plan().to_json()), "format_version": 7}))
    with pytest.raises(InputError, match="format_version = 7"):
        load_plan(path)


def spot_positions(plan: Plan, rig: RigConfig, mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Where the spots lie, and the cosine of incidence: on a sphere by solving the quadratic, without a ray caster."""
    radius = float(np.linalg.norm(mesh.vertices[0]))
    positions, cosines = [], []
    for aim in plan.spots:
        frame = turn(plan.angles_rad[aim.angle])
        origin, direction = (
            TwoMirrorProjector.from_config(rig.projector).seen_from(frame).rays(np.array([[aim.u, aim.v]], float))
        )
        b = float(origin[0] @ direction[0])
        root = b * b - float(origin[0] @ origin[0]) + radius**2
        point = origin[0] + (-b - np.sqrt(max(root, 0))) * direction[0]
        positions.append(point)
        cosines.append(-float(point @ direction[0]) / radius)
    return np.array(positions), np.array(cosines)


def test_spots_are_as_many_as_asked_oblique_at_most_as_allowed_and_even() -> None:
    """Expected on a sphere lit from three sides: nearest-neighbour distances vary by less than a fifth of their mean
    (a random choice varies by half), and no reachable place is farther from a spot than 1.5 mean distances."""
    rig = RigConfig(cameras=(CAMERA,), turntable_angles_deg=(0, 120, 240), spots=300)
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=20.0)
    plan = make_plan(rig, mesh)
    assert len(plan.spots) == 300 == len(set(plan.spots))
    assert all(0 <= step < 4096 for aim in plan.spots for step in (aim.u, aim.v))
    where, cosine = spot_positions(plan, rig, mesh)
    assert np.rad2deg(np.arccos(cosine.min())) < 60 + 2.5  # half a facet is 2 degrees across
    nearest = cKDTree(where).query(where, k=2)[0][:, 1]
    assert nearest.std() / nearest.mean() < 0.2
    dense, _ = spot_positions(make_plan(rig.model_copy(update={"spots": 2000}), mesh), rig, mesh)
    assert cKDTree(where).query(dense)[0].max() < 1.5 * nearest.mean()


def test_plan_is_reproducible() -> None:
    rig = RigConfig(cameras=(CAMERA,), turntable_angles_deg=(0, 180), spots=50)
    assert make_plan(rig, ball()).digest == make_plan(rig, ball()).digest


def farthest_points_by_definition(points: np.ndarray, cosine: np.ndarray, count: int) -> list[int]:
    """The reference: all distances to all chosen points, every time."""
    chosen = [int(np.argmax(cosine))]
    while len(chosen) < count:
        squared = ((points[:, None] - points[None, chosen]) ** 2).sum(-1).min(axis=1)
        squared[chosen] = -1
        chosen.append(int(np.argmax(squared * cosine)))
    return chosen


@pytest.mark.parametrize("count", [1, 2, 40, 200])
def test_farthest_points_are_those_of_the_definition(count: int) -> None:
    random = np.random.default_rng(3)
    points, cosine = random.standard_normal((200, 3)), random.uniform(0.3, 1, 200)
    assert farthest_points(points, cosine, count).tolist() == farthest_points_by_definition(points, cosine, count)


def test_farthest_points_on_coincident_and_collinear_points() -> None:
    """Extreme cases: all at one place, still `count` different ones; on a line, the two ends and then the middle."""
    assert sorted(farthest_points(np.zeros((5, 3)), np.ones(5), 5).tolist()) == [0, 1, 2, 3, 4]
    line = np.zeros((101, 3))
    line[:, 0] = np.arange(101)
    assert farthest_points(line, np.ones(101), 3).tolist() == [0, 100, 50]


def test_concave_objects_shadow_themselves() -> None:
    """A small ball in front of a big one takes the light: no spot lies on the big one behind it."""
    front = trimesh.creation.icosphere(subdivisions=3, radius=8.0)
    front.apply_translation([40, 0, 0])
    mesh = trimesh.util.concatenate([ball(), front])
    rig = RigConfig(cameras=(CAMERA,), spots=200, projector=ProjectorConfig(position_mm=(600, 0, 0), separation_mm=0.0))
    plan = make_plan(rig, mesh)
    origin, direction = TwoMirrorProjector.from_config(rig.projector).rays(
        np.array([(aim.u, aim.v) for aim in plan.spots], float)
    )
    along = (40 - origin[:, 0]) / direction[:, 0]  # where the beam passes the small ball's centre plane
    off_axis = np.linalg.norm((origin + along[:, None] * direction)[:, 1:], axis=1)
    depth = mesh.ray.intersects_location(origin, direction, multiple_hits=False)
    on_big = depth[0][:, 0] < 30
    assert on_big.any()
    assert not on_big.all()
    assert off_axis[depth[1][on_big]].min() > 7.9


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"projector": ProjectorConfig(aim_mm=(0, 0, 500), full_angle_deg=5)}, "laser never hits the object"),
        ({"cameras": (CAMERA.model_copy(update={"aim_mm": (900.0, 60.0, 100.0)}),)}, "does not see the object"),
        ({"projector": ProjectorConfig(steps=16, full_angle_deg=12), "spots": 300}, "places only"),
    ],
)
def test_rigs_that_cannot_work_are_refused(change: dict[str, object], says: str) -> None:
    rig = RigConfig(cameras=(CAMERA,), spots=20).model_copy(update=change)
    with pytest.raises(InputError, match=says) as caught:
        make_plan(rig, ball())
    assert "\n" not in str(caught.value)


def test_a_camera_inside_a_face_sees_the_object() -> None:
    """A box that fills the image and has no vertex in it is seen all the same."""
    box = trimesh.creation.box((200, 200, 200)).subdivide().subdivide().subdivide()
    camera = CAMERA.model_copy(update={"position_mm": (390.0, 0.0, 0.0), "focal_length_mm": 25.0})
    rig = RigConfig(cameras=(camera,), spots=5)
    assert len(make_plan(rig, box).spots) == 5
