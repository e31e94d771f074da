"""Input that is bad in less obvious ways: one line that names file, key and remedy, and nothing lost."""

from __future__ import annotations

import errno
import logging
import os
from io import StringIO
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import trimesh
from rich.console import Console
from scene_fakes import sphere
from scene_texts import GOOD

from disco_twin.evaluate.scores import load_relit, load_scores
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.pipeline_process import load_results, pipeline_inputs, stale
from disco_twin.experiment.references import (
    holds_reference,
    read_reference,
    reference_key,
    reference_path,
    render_references,
)
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.light.references import Reference, load_reference, save_reference
from disco_twin.light.truth import Truth
from disco_twin.object.mesh import read_mesh
from disco_twin.object.voxels import read_voxels
from disco_twin.run.progress import run_log
from disco_twin.run.scan import require_capturable
from disco_twin.scene.object_schema import MediumConfig
from disco_twin.scene.scene import Scene, load_scene
from hw.base.config import read_json
from hw.base.errors import InputError, naming, refused_by_the_disk
from hw.base.files import write_atomically
from pipeline.geometry.distortion import covers_image
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.records import MethodFigures, NominalRigFile, PipelineRecord


def one_line(caught: pytest.ExceptionInfo[InputError], *parts: str) -> None:
    message = str(caught.value)
    assert "\n" not in message
    for part in (*parts, "Remedy"):
        assert part in message, message


@pytest.mark.parametrize("value", ["true", '"20"', "20.0", "[20]"])
def test_a_number_is_a_number(value: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(GOOD.replace("[[rig.cameras]]", f"[rig]\nspots = {value}\n[[rig.cameras]]", 1))
    with pytest.raises(InputError, match=r"rig\.spots = .*is no whole number.*Remedy"):
        load_scene(path)


@pytest.mark.parametrize("value", ["true", "1.0"])
def test_a_format_version_is_an_integer(value: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(GOOD.replace("format_version = 1", f"format_version = {value}", 1))
    with pytest.raises(InputError, match="format_version = "):
        load_scene(path)


def test_more_vertices_than_a_model_can_hold(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(GOOD.replace("vertices = 642", "vertices = 900000", 1))
    with pytest.raises(InputError, match=r"scan\.vertices = 900000: R_d holds the square.*20000"):
        load_scene(path)


CAMERA = {"name": "a", "width": 32, "height": 32}


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"cameras": [CAMERA | {"position_mm": (3, 1, 2)}]}, ["rig.cameras[0].position_mm", "inside the object"]),
        (
            {"cameras": [CAMERA | {"position_mm": (450, 0, 50), "focal_length_mm": 6000.0}]},
            ["rig.cameras[0].focal_length_mm = 6000.0", "mm^2 of the object only"],
        ),
        (
            {"cameras": [CAMERA | {"position_mm": (450, 0, 50), "focal_length_mm": 0.2}]},
            ["rig.cameras[0].focal_length_mm = 0.2", "pixels"],
        ),
        (
            {"projector": {"position_mm": (3, 1, 2)}},
            ["rig.projector.position_mm = [3.0, 1.0", "inside the object"],
        ),
    ],
)
def test_devices_that_cannot_see_the_object(changes: dict[str, object], parts: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        require_capturable(sphere(**changes))
    one_line(caught, *parts)


def test_too_few_spots_are_refused_before_they_are_taken() -> None:
    """A rig that is off the nominal one is calibrated by its spots; one that is not can do with any."""
    with pytest.raises(InputError) as caught:
        require_capturable(
            sphere(cameras=[CAMERA | {"position_mm": (450, 0, 50)}], spots=3, faults={"deviation": True})
        )
    one_line(caught, "rig.spots = 3", "at least 12", "Remedy: ")
    require_capturable(sphere(cameras=[CAMERA | {"position_mm": (450, 0, 50)}], spots=3))


@pytest.mark.parametrize(
    "base",
    [
        {"sigma_t_per_mm": 0.0, "albedo": 0.9},
        {"sigma_t_per_mm": 1.0, "albedo": 0.0},
        {"sigma_t_per_mm": 1e-6, "albedo": 0.9},
    ],
)
def test_an_object_that_scatters_nothing(base: dict[str, float]) -> None:
    experiment = sphere()
    medium = MediumConfig.model_validate({"base": base | {"kind": "homogeneous"}})
    changed = experiment.scene.object.model_copy(update={"medium": medium})
    experiment.scene = experiment.scene.model_copy(update={"object": changed})
    with pytest.raises(InputError) as caught:
        require_capturable(experiment)
    one_line(caught, "object.medium: nothing scatters light of 635, 532, 476 nm", "Remedy: ")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            OSError("Not enough free space to write 22855680 bytes after offset 128"),
            "the disk is full. Remedy: make room",
        ),
        (OSError("16 requested and 0 written"), "the disk is full. Remedy: make room"),
        (OSError(errno.ENOSPC, "No space left on device"), "the disk is full. Remedy: make room"),
        (OSError(errno.EFBIG, "File too large"), "no file may be that large here. Remedy: raise the limit (ulimit -f)"),
    ],
)
def test_a_full_disk_is_told_from_a_limit_of_files(error: OSError, said: str) -> None:
    """NumPy's own words for a full disk have neither number nor file."""
    known = refused_by_the_disk(error, Path("out/twin"))
    assert str(known).startswith(f"out/twin: {said}")
    assert refused_by_the_disk(OSError(errno.EIO, "Input/output error"), Path("out")) is None


def test_an_error_about_a_key_names_the_scene() -> None:
    with pytest.raises(InputError, match=r"^a\.toml: key = 1: wrong"), naming("a.toml"):
        raise InputError("wrong", key="key", value=1)
    with pytest.raises(InputError, match=r"^b\.ply: wrong"), naming("a.toml"):
        raise InputError("wrong", file="b.ply")


def ball(size: float = 20.0, shift: float = 0.0, inward: bool = False) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=size)
    mesh.apply_translation([shift, 0.1 * shift, 0.0])
    if inward:
        mesh.invert()
    return mesh


@pytest.mark.parametrize(
    ("parts", "why"),
    [
        ([ball(), ball(shift=15)], "intersects itself"),
        ([ball(), ball(10)], "not oriented inwards"),
        ([ball(), ball(10, inward=True)], None),
        ([ball(), ball(10, inward=True), ball(5)], None),
        ([ball(10), ball(10, shift=50)], None),
        ([ball(10), ball(10, shift=50, inward=True)], "inside out"),
        ([ball(inward=True)], "inside out"),
    ],
)
def test_shells(parts: list[trimesh.Trimesh], why: str | None, tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    trimesh.util.concatenate(parts).export(path)
    if why is None:
        assert read_mesh(path).is_watertight
        return
    with pytest.raises(InputError, match=why) as caught:
        read_mesh(path)
    one_line(caught, str(path))


@pytest.mark.parametrize("name", ["a.stl", "a.ply", "a.obj"])
def test_garbage_meshes(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(bytes(range(256)) * 8)
    with pytest.raises(InputError) as caught:
        read_mesh(path)
    one_line(caught, str(path), "object.shape.file")
    assert "charset" not in str(caught.value)


def test_garbage_grids(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    path.write_bytes(b"\x80\x04garbage")
    with pytest.raises(InputError) as caught:
        read_voxels(path, 3, "key")
    one_line(caught, str(path), "numpy.save")
    assert "pickle" not in str(caught.value)
    vol = tmp_path / "a.vol"
    head = np.array([1, 2, 2, 2, 1], "<i4").tobytes() + np.array([0, 0, np.nan, 9, 9, 9], "<f4").tobytes()
    vol.write_bytes(b"VOL\x03" + head + np.ones(8, "<f4").tobytes())
    with pytest.raises(InputError) as caught:
        read_voxels(vol, 3, "key")
    one_line(caught, str(vol), "corners")


@pytest.mark.parametrize(
    ("distortion", "good"),
    [
        ((0.0, 0.0, 0.0, 0.0, 0.0), True),
        ((-0.3, 0.1, 0.001, -0.001, 0.0), True),
        ((0.5, 0.0, 0.0, 0.0, 0.0), True),
        ((-4.0, 0.0, 0.0, 0.0, 0.0), False),  # 1 = 3 |k1| r^2 at r = .289, where r (1 + k1 r^2) = .192
        ((-1.3, 0.0, 0.0, 0.0, 0.0), True),  # turns over at .506, image .338 > .25, the corner
        ((-2.6, 0.0, 0.0, 0.0, 0.0), False),  # at .358, image .239 < .25
        ((0.0, 0.0, 3.0, 0.0, 0.0), False),
    ],
)
def test_distortion_must_be_one_to_one(distortion: tuple[float, ...], good: bool) -> None:
    assert covers_image(distortion, 0.2, 0.15) == good


@pytest.mark.parametrize("content", ["", "[" * 100_000, "[1]", '{"format_version": 2}', "\x00\xff", "{}", "null"])
def test_damaged_json(content: str, tmp_path: Path) -> None:
    path = tmp_path / "f.json"
    path.write_text(content)
    for schema in (PipelineRecord, Scene, NominalRigFile):
        with pytest.raises(InputError) as caught:
            read_json(path, schema, "do that")
        one_line(caught, str(path), "do that")
    folder = RunFolder(tmp_path)
    folder.twin.mkdir()
    folder.work.mkdir()
    for file, load in ((folder.twin / "scores.json", load_scores), (folder.work / "pipeline.json", load_results)):
        file.write_text(content)
        with pytest.raises(InputError) as caught:
            load(folder)
        one_line(caught, str(file), "delete it")
    path.unlink()
    with pytest.raises(InputError, match="is missing"):
        read_json(path, Scene, "do that")


def test_damaged_arrays(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    file = folder.work / "relit" / "default" / "l@v.npy"
    file.parent.mkdir(parents=True)
    view = CameraConfig(name="v", position_mm=(400.0, 0.0, 0.0), width=64, height=48)
    file.write_bytes(b"\x80garbage")
    with pytest.raises(InputError) as caught:
        load_relit(folder, "default", "l", view)
    one_line(caught, str(file), "reconstruct")
    np.save(file, np.zeros((3, 4, 4), np.float32))
    with pytest.raises(InputError) as caught:
        load_relit(folder, "default", "l", view)
    one_line(caught, str(file), "(3, 4, 4)", "(lasers, 48, 64)", "reconstruct")
    truth = tmp_path / "truth.npz"
    for content in (b"", b"\x80garbage", b"PK\x03\x04" + bytes(40)):
        truth.write_bytes(content)
        with pytest.raises(InputError) as caught:
            Truth.load(truth)
        one_line(caught, str(truth), "disco-twin run")
    truth.unlink()
    with pytest.raises(InputError, match="missing"):
        Truth.load(truth)


def test_references_that_are_gone_or_damaged(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    with pytest.raises(InputError) as caught:
        load_reference(path)
    one_line(caught, "missing", "disco-twin run renders it")
    path.write_bytes(b"garbage")
    with pytest.raises(InputError) as caught:
        load_reference(path)
    one_line(caught, str(path), "delete it")
    with pytest.raises(InputError) as caught:
        render_references(sphere(), tmp_path, path, lambda done, total: None)
    one_line(caught, str(path), "is not a folder", "another --out")


@pytest.mark.parametrize("change", ["rgb", "no noise", "cut", "size", "brighter"])
def test_references_that_other_programs_saved(
    change: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """One line of ours, none of the EXR library; a reference of the wrong size is rendered again, too."""
    experiment = sphere()
    light, view = experiment.scene.relight.lights[0], experiment.scene.relight.views[0]
    path = reference_path(tmp_path, light, view)
    rows = view.height // (2 if change == "size" else 1)
    halves = np.random.default_rng(0).random((2, 2, 3, rows, view.width)).astype(np.float32)
    key = reference_key(experiment.scene, light, view)
    save_reference(path, Reference(halves, 1e-3, key))
    with OpenEXR.File(str(path), separate_channels=True) as file:
        header, channels = dict(file.header()), {name: channel.pixels for name, channel in file.channels().items()}
    if change == "rgb":
        OpenEXR.File(header, dict(zip("RGB", channels.values(), strict=False))).write(str(path))
    elif change == "no noise":
        OpenEXR.File({k: v for k, v in header.items() if k != "noise"}, channels).write(str(path))
    elif change == "brighter":
        OpenEXR.File(header, {k: (v * np.float16(0.5)).astype(np.float16) for k, v in channels.items()}).write(
            str(path)
        )
    elif change == "cut":
        path.write_bytes(path.read_bytes()[:-400])
    assert not holds_reference(tmp_path, experiment, light, view)
    assert [record.getMessage().endswith("another one is rendered") for record in caplog.records] == [True]
    assert capfd.readouterr() == ("", "")
    if change != "size":
        with pytest.raises(InputError) as caught:
            read_reference(path)
        one_line(caught, str(path), "Remedy: delete it, disco-twin run renders it again")
    save_reference(path, Reference(np.ones((2, 2, 3, view.height, view.width), np.float32), 1e-3, key))
    assert holds_reference(tmp_path, experiment, light, view)


def test_a_reference_is_replaced_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, halves = tmp_path / "uniform@left.exr", np.ones((2, 2, 1, 4, 5), np.float32)
    save_reference(path, Reference(halves, 0.1, "old"))

    def half(_: OpenEXR.File, name: str) -> None:
        Path(name).write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(OpenEXR.File, "write", half)
    with pytest.raises(OSError, match="No space left"):
        save_reference(path, Reference(halves, 0.1, "new"))
    assert load_reference(path).key == "old" and list(tmp_path.iterdir()) == [path]
    np.testing.assert_allclose(load_reference(path).halves, halves, rtol=1e-3)  # half floats


def test_a_model_that_does_not_belong_to_what_is_scored(tmp_path: Path) -> None:
    scene = sphere().scene
    folder = RunFolder(tmp_path)
    folder.work.mkdir()
    figures = MethodFigures(seconds=1.0, provenance={})
    methods = {"default": figures}
    made = PipelineRecord(format_version=1, stages=(), methods=methods, capture={}, left_out=(), warnings=())
    (folder.work / "pipeline.json").write_text(made.model_dump_json())
    write_request = folder.work / "request.json"
    write_request.write_text(_json(pipeline_inputs(scene, ("default",))))
    assert stale(scene, folder, ("default",)) is None
    assert "did not make dipole, only default" in str(stale(scene, folder, ("default", "dipole")))
    other = scene.model_copy(update={"reconstruct": scene.reconstruct.model_copy(update={"eta": 1.5})})
    assert "has changed" in str(stale(other, folder, ("default",)))


def _json(data: object) -> str:
    import json

    return json.dumps(data)


def test_a_full_disk_names_the_file_and_leaves_a_folder_that_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text("name = 'x'\n")
    with monkeypatch.context() as patched:

        def full(_: int) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        patched.setattr(os, "fsync", full)
        with pytest.raises(OSError) as caught:
            RunFolder.claim(tmp_path / "out", scene, "one")
    assert caught.value.errno == errno.ENOSPC
    assert caught.value.filename == str(tmp_path / "out" / "scene.toml")
    assert not list((tmp_path / "out").glob("*.part"))
    RunFolder.claim(tmp_path / "out", scene, "one")
    (tmp_path / "out" / "stages.json").rename(tmp_path / "out" / "stages.json.part")  # killed just before
    RunFolder.claim(tmp_path / "out", scene, "one")
    (tmp_path / "out" / "stages.json").unlink()
    write_atomically(tmp_path / "out" / "capture" / "images.bin", b"1")  # somebody's capture is no beginning
    with pytest.raises(InputError, match="not empty"):
        RunFolder.claim(tmp_path / "out", scene, "one")


def test_a_killed_stage_is_not_taken_for_finished(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.run("pipeline", "a", lambda: None)
    seen: list[bool] = []
    folder.run("pipeline", "b", lambda: seen.append(RunFolder.open(tmp_path).stages["pipeline"].finished))
    assert seen == [False]


def test_two_processes_in_one_folder(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)

    def nested() -> None:
        RunFolder(tmp_path).run("capture", "k", lambda: None)

    with pytest.raises(Exception, match="another process works in this folder"):
        folder.run("capture", "k", nested)


def test_warnings_are_seen_on_the_screen(tmp_path: Path) -> None:
    out = StringIO()
    with run_log(tmp_path / "run.log", Console(file=out, width=40)):
        logging.getLogger("disco_twin.run.stages").warning("damaged and left out: image 7 (view 0, spot 3, laser 1)")
        logging.getLogger("disco_twin.run.stages").info("not this")
    assert out.getvalue() == "  warning: damaged and left out: image 7 (view 0, spot 3, laser 1)\n"
    assert "not this" in (tmp_path / "run.log").read_text()


def test_a_mesh_too_large_for_a_model(monkeypatch: pytest.MonkeyPatch) -> None:
    experiment = sphere()
    scene = experiment.scene.model_copy(update={"scan": experiment.scene.scan.model_copy(update={"vertices": None})})
    monkeypatch.setattr("disco_twin.object.build.MOST_VERTICES", 500)
    with pytest.raises(InputError) as caught:
        _ = Experiment(scene).scan
    one_line(caught, "scan.vertices", "at most 500")
