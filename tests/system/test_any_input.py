"""Whatever is in scenes, rig files, streams, calibrations and models: accepted and right, or refused in one line.

A few examples here, 2,000 of each kind in the slow suite.
"""

from __future__ import annotations

import json
import shutil
import tomllib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from capture_fakes import SHAPE, frame, small_plan
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutations import mutated, toml
from rig_files import CAMERAS, rig_file
from scene_texts import GOOD

from benchmarks.stability.case import said_in_one_line
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.keys import identity
from disco_twin.object import shapes
from disco_twin.scene.scene import load_scene
from hw.base.errors import DiscoError, InputError
from hw.record import RawImage, Sensor
from hw.rig.rig_file import DevicesFile
from hw.rig.rig_rules import load_rig_file
from pipeline.calibrate.calibration import Calibration, nominal_calibration
from pipeline.geometry.camera import PinholeCamera, look_at
from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.nominal_rig import CameraConfig, RigConfig
from pipeline.model.lambertian import LambertianTerm
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.relight.lights import Uniform
from pipeline.stream.stream import CorruptImage, ImageMeta, StreamReader, StreamWriter

FEW, MANY = 15, 2000
Check = Callable[[Any, Path], None]


def both(strategy: Callable[[], st.SearchStrategy[Any]]) -> Callable[[Check], Any]:
    """A test of a few examples, and one of many that is slow."""

    def decorate(check: Check) -> Any:
        @pytest.mark.parametrize(
            "examples", [FEW, pytest.param(MANY, marks=[pytest.mark.slow, pytest.mark.timeout(1800)])]
        )
        def test(examples: int, tmp_path: Path) -> None:
            @settings(max_examples=examples, database=None, derandomize=True, suppress_health_check=list(HealthCheck))
            @given(strategy())
            def run(data: Any) -> None:
                check(data, tmp_path)

            run()

        test.__doc__ = check.__doc__
        return test

    return decorate


def accepted(read: Callable[[], Any]) -> Any:
    """What was read; None where it was refused as it should be."""
    try:
        return read()
    except DiscoError as error:
        if not said_in_one_line(error):
            raise
        return None


# ---------------------------------------------------------------- scenes
def scene_data() -> dict[str, Any]:
    data = tomllib.loads(GOOD)
    data["rig"] |= {
        "spots": 20,
        "projector": {"full_angle_deg": 12.0, "steps": 4096},
        "turntable_angles_deg": [0.0, 90.0],
    }
    data["object"]["boundary"] = {"kind": "rough", "eta": 1.3, "alpha": 0.3}
    data["object"]["medium"] |= {"g": 0.2, "cell_mm": 1.0}
    data["simulation"] = {"walks_per_spot": 1000, "truth_columns": 4}
    data["relight"]["lights"] = [
        "uniform",
        {"kind": "beam", "name": "b", "direction": [1.0, 0.0, 0.0], "diameter_mm": 2.0},
    ]
    return data


@both(lambda: mutated(scene_data()))
def test_scenes(data: dict[str, Any], folder: Path) -> None:
    """Expected: the same scene again from its own values; its object, scan and plan can be made, or are refused."""
    path = folder / "scene.toml"
    path.write_text(toml(data), encoding="utf-8")
    scene = accepted(lambda: load_scene(path))
    if scene is None:
        return
    assert type(scene).model_validate(scene.model_dump()) == scene
    assert len(identity(scene)) == 64
    json.dumps(scene.model_dump(mode="json"), allow_nan=False)
    fine, shapes.SUBDIVISIONS = shapes.SUBDIVISIONS, 3
    try:
        obj = accepted(lambda: Experiment(scene).object)
    finally:
        shapes.SUBDIVISIONS = fine
    if obj is not None:
        assert obj.mesh.is_watertight and obj.mesh.volume > 0
        assert all(np.isfinite(a).all() and (a >= 0).all() for a in (obj.medium.sigma_t, obj.medium.albedo))
        assert obj.medium.albedo.max() <= 1 and max(map(abs, obj.medium.g)) < 1


# ---------------------------------------------------------------- rig files
@cache
def rig_data(folder: Path) -> dict[str, Any]:
    return tomllib.loads(rig_file(folder, cameras=CAMERAS).read_text())


def test_rig_files(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    any_rig_file(tmp_path, tmp_path_factory, FEW)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_many_rig_files(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    any_rig_file(tmp_path, tmp_path_factory, MANY)


def any_rig_file(folder: Path, factory: pytest.TempPathFactory, examples: int) -> None:
    """Expected: the same rig again from its own values; its bracket and its sensor are such as a camera can have."""
    data = rig_data(factory.getbasetemp())

    @settings(max_examples=examples, database=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(mutated(data))
    def run(changed: dict[str, Any]) -> None:
        path = folder / "rig.toml"
        path.write_text(toml(changed), encoding="utf-8")
        rig = accepted(lambda: load_rig_file(path))
        if rig is None:
            return
        assert DevicesFile.model_validate(rig.model_dump()).model_dump() == rig.model_dump()
        assert rig.lamp_line not in {laser.gate_line for laser in rig.lasers}
        if rig.sensor is not None:
            assert rig.sensor.bracket().exposure_s(rig.sensor.exponents[-1]) > 0
            assert rig.sensor.sensor().saturation_dn >= rig.sensor.saturation_dn

    run()


# ---------------------------------------------------------------- calibrations
@cache
def calibration_data() -> str:
    camera = {"position_mm": (450.0, 0.0, 50.0), "width": 16, "height": 16}
    rig = RigConfig(
        cameras=(
            CameraConfig(name="a", **camera),
            CameraConfig(name="b", **camera | {"position_mm": (0.0, 400.0, 90.0)}),
        ),
        turntable_angles_deg=(0.0, 90.0),
    )
    sensor = Sensor(1 / 30, 12, 12, 24.8, 25.0, 500.0, 64.0, (1e13, 1e13, 1e13), 43750.0)
    return nominal_calibration(rig, sensor).model_dump_json()


@both(lambda: mutated(json.loads(calibration_data())))
def test_calibrations(data: dict[str, Any], folder: Path) -> None:
    """Expected: rays of every view and spot, and radiances of a record, that are finite."""
    path = folder / "calibration.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    found = accepted(lambda: Calibration.load(path))
    if found is None:
        return
    corners = np.array([[0.5, 0.5], [8.0, 8.0]])
    with np.errstate(all="ignore"):
        for view, own in enumerate(found.views):
            camera = found.view_camera(view)
            _, towards = camera.rays(corners * [own.width / 16, own.height / 16])
            np.testing.assert_allclose(np.linalg.norm(towards, axis=1), 1.0, atol=1e-6)
            if own.width * own.height < 1e4:
                shape = own.height, own.width
                raw = RawImage(np.zeros(shape, np.uint8), np.full(shape, 200, np.uint16))
                image = found.radiance(raw, view, 0)
                assert np.isfinite(image.radiance).all() and (image.variance > 0).all()
        for angle in range(found.n_angles):
            origins, towards = found.projector(angle).rays(np.array([[0.0, 0.0], [100.0, 50.0]]))
            assert np.isfinite(origins).all()
            np.testing.assert_allclose(np.linalg.norm(towards, axis=1), 1.0, atol=1e-6)


# ---------------------------------------------------------------- models
BALL = trimesh.creation.icosphere(subdivisions=1, radius=10.0)
VIEW = PinholeCamera(12, 12, np.full(2, 200.0), np.full(2, 6.0), np.zeros(5), look_at((400.0, 30.0, 50.0), (0, 0, 0)))


@cache
def model_arrays(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Head and arrays of a model's file."""
    count = len(BALL.vertices)
    entries = np.exp(-np.linalg.norm(BALL.vertices[:, None] - BALL.vertices, axis=2) / 3)[None].astype(np.float32)
    term = GlobalTerm(entries, np.ones((count, count), bool), (0.01 * entries**2).astype(np.float32))
    model = RelightableModel(BALL, Boundary(1.3), (term, LambertianTerm(np.full((1, count), 0.1, np.float32))))
    model.save(folder / "whole.npz")
    with np.load(folder / "whole.npz") as data:
        arrays = {name: data[name] for name in data.files}
    return json.loads(str(arrays.pop("head"))), arrays


CHANGES = st.tuples(
    st.sampled_from(["term0.reflectance", "term0.measured", "term0.variance", "term1.albedo", "vertices", "faces"]),
    st.sampled_from(["value", "shape", "kind", "gone", "turned", "empty"]),
    st.sampled_from([np.nan, np.inf, -1.0, 0.0, 1e30, 1e-30]),
    st.integers(0, 10_000),
)  # fmt: skip


def changed(arrays: dict[str, Any], name: str, how: str, value: float, at: int) -> None:
    array = arrays[name].copy()
    if how == "value" and not array.size:
        return
    if how == "value" and array.dtype.kind == "f":
        array.flat[at % array.size] = value
    elif how == "value":
        array.flat[at % array.size] = at
    elif how == "shape":
        array = array[..., :-1]
    elif how == "kind":
        array = array.real.astype(np.complex64 if at % 2 else np.int16)
    elif how == "turned":
        array = array.swapaxes(-1, -2)
    elif how == "empty":
        array = array[:0]
    arrays[name] = array
    if how == "gone":
        del arrays[name]


@both(lambda: st.tuples(st.lists(CHANGES, max_size=2), st.booleans(), st.data()))
def test_models(drawn: Any, folder: Path) -> None:
    """Expected: an image that is finite."""
    changes, of_head, data = drawn
    head, arrays = model_arrays(folder)
    arrays = dict(arrays)
    for name, how, value, at in changes:
        if name in arrays:
            changed(arrays, name, how, value, at)
    if of_head:
        head = data.draw(mutated(head))
    path = folder / "model.npz"
    np.savez(path, head=np.array(json.dumps(head)), **arrays)
    model = accepted(lambda: RelightableModel.load(path))
    if model is None:
        return
    light = Uniform(colour=(1.0,) * model.lasers)
    with np.errstate(all="ignore"):
        image = model.image(model.lit_by(light), model.seen_by(VIEW))
    assert np.isfinite(image).all()


# ---------------------------------------------------------------- streams
PLAN = small_plan()
DAMAGE = st.lists(
    st.tuples(
        st.sampled_from(["images.bin", "journal.bin", "plan.json"]),
        st.sampled_from(["flip", "cut", "insert", "remove"]),
        st.integers(0, 10**6), st.binary(min_size=1, max_size=6),
    ),
    min_size=1, max_size=3,
)  # fmt: skip


def write_stream(folder: Path) -> None:
    with StreamWriter(folder, PLAN) as stream:
        for index in range(len(PLAN)):
            stream.append(
                PLAN.address(index), frame(SHAPE, index), ImageMeta(index / 15, 0.01, 0.7 * index, index, 2 * index)
            )


@both(lambda: DAMAGE)
def test_streams(changes: list[tuple[str, str, int, bytes]], folder: Path) -> None:
    """Expected: every image is what was written, or said to be damaged; none is another one."""
    whole, damaged = folder / "whole", folder / "damaged"
    if not whole.exists():
        whole.mkdir()
        write_stream(whole)
    shutil.rmtree(damaged, ignore_errors=True)
    shutil.copytree(whole, damaged)
    for name, how, at, new in changes:
        content = (damaged / name).read_bytes()
        at %= len(content) + 1
        if how == "flip":
            content = content[:at] + new + content[at + len(new) :]
        elif how == "cut":
            content = content[:at]
        elif how == "insert":
            content = content[:at] + new + content[at:]
        else:
            content = content[:at] + content[at + len(new) :]
        (damaged / name).write_bytes(content)
    reader = accepted(lambda: StreamReader(damaged))
    if reader is None:
        return
    with reader:
        assert len(reader) <= len(PLAN)
        for index, image in enumerate(reader):
            if not isinstance(image, CorruptImage):
                exact = frame(SHAPE, index)
                assert np.array_equal(image.charge, exact.charge) and np.array_equal(image.exponent, exact.exponent)
        accepted(reader.require_complete)


def test_a_refusal_of_several_lines_is_no_refusal() -> None:
    assert not said_in_one_line(InputError("a\nb", remedy="c"))
    assert not said_in_one_line(DiscoError("nothing to be done"))
    assert not said_in_one_line(InputError("out of range", allowed="0 to 1"))
    assert said_in_one_line(InputError("a", remedy="c"))
