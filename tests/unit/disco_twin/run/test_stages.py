"""A stage is done again when what it depends on has changed, the code included; old light is never continued."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from scene_fakes import sphere

from disco_twin.experiment import keys
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.keys import code_key, import_closure
from disco_twin.experiment.run_folder import RunFolder, StageRecord
from disco_twin.faults.actual_rig import actual_rig
from disco_twin.light.backend import activate
from disco_twin.report.collect import notes
from disco_twin.run import stages
from disco_twin.run.progress import Report
from disco_twin.run.stages import Run, capture_stages, drop_outdated, pipeline_stage, score_stages, truth_stages
from pipeline.records import MethodFigures, PipelineRecord


class Scored(Exception):
    """Ends `score_stages` after the stage's key is known."""


@dataclass(frozen=True)
class Recorded(Run):
    """Notes the stages' keys instead of doing them."""

    def stage(self, name: str, key: str, work: Callable[[Report], Any], unit: str = "") -> None:
        self.folder.stages[name] = StageRecord(name, key, finished=True)
        if name == "scores":
            raise Scored


def keys_of(folder: RunFolder, methods: tuple[str, ...] = ("default",)) -> dict[str, str]:
    run = Recorded(sphere(faults={"deviation": True}, spots=200), folder, folder.scene_file, methods, QUIET)
    capture_stages(run)
    truth_stages(run)
    pipeline_stage(run)
    with pytest.raises(Scored):
        score_stages(run)
    return {name: record.key for name, record in folder.stages.items()}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    done = PipelineRecord(format_version=1, stages=(), methods={}, capture={}, left_out=(), warnings=())
    monkeypatch.setattr(stages, "load_results", lambda folder: done)
    monkeypatch.setattr(stages, "stale", lambda *_: None)
    scene = tmp_path / "scene.toml"
    scene.write_text("")
    return RunFolder.claim(tmp_path / "out", scene, "one")


QUIET = Console(quiet=True)
ALL = {"scan", "targets", "capture", "truth", "references", "pipeline", "scores"}


@pytest.mark.parametrize(
    ("module", "again"),
    [
        ("disco_twin.object.shapes", ALL - {"targets"}),
        ("disco_twin.light.walk", ALL - {"targets"}),
        ("disco_twin.emulation.twin_rig", {"targets", "capture", "pipeline", "scores"}),
        ("disco_twin.camera.targets", {"targets", "pipeline", "scores"}),
        ("pipeline.geometry.fresnel", {"pipeline", "scores"}),
        ("pipeline.reconstruct.global_term.completion", {"pipeline", "scores"}),
        ("pipeline.relight.scores", {"scores"}),
        ("disco_twin.evaluate.summary", set()),
        ("disco_twin.report.page", set()),
        ("disco_twin.run.stages", set()),
    ],
)
def test_changed_code_does_its_stages_again(
    module: str, again: set[str], folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, source = keys_of(folder), keys._source
    assert source(module).is_file()
    monkeypatch.setattr(keys, "_source", lambda name: folder.scene_file if name == module else source(name))
    monkeypatch.setattr(stages, "code_key", code_key.__wrapped__)  # no cache
    after = keys_of(folder)
    assert set(before) == ALL
    assert {name for name in ALL if before[name] != after[name]} == again


def test_another_renderer_makes_light_again(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stages, "code_key", code_key.__wrapped__)  # no cache
    before = keys_of(folder)
    for package in ("mitsuba", "drjit", "numpy", "scipy"):
        with monkeypatch.context() as upgraded:
            upgraded.setattr(keys, "version", lambda name, p=package: "99" if name == p else version(name))
            after = keys_of(folder)
        assert {name for name in ALL if before[name] != after[name]} == ALL - {"targets"}


def test_the_pipeline_reads_what_devices_left(folder: RunFolder) -> None:
    """A capture that was taken anew, and photographs of targets that were added, are reconstructed again."""
    run = Recorded(sphere(), folder, folder.scene_file, ("default",), QUIET)

    def key() -> str:
        pipeline_stage(run)
        return folder.stages["pipeline"].key

    files = ("devices.toml", "plan.json", "journal.bin", "sensor.json", "scan.ply", "calibration/a/targets.json")
    (folder.capture / "calibration" / "a").mkdir(parents=True)
    found = []
    for content in ("old", "new"):  # of one size
        for name in files:
            (folder.capture / name).write_text(content)
            found.append(key())
    assert len(set(found)) == len(found) and key() == key()


def test_scores_notice_what_devices_took_since_the_reconstruction(
    folder: RunFolder, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made = {"default": MethodFigures(seconds=1.0, provenance={})}
    done = PipelineRecord(format_version=1, stages=(), methods=made, capture={}, left_out=(), warnings=())
    monkeypatch.setattr(stages, "load_results", lambda folder: done)
    run = Recorded(sphere(), folder, folder.scene_file, ("default",), QUIET)
    for name in ("devices.toml", "journal.bin"):
        (folder.capture / name).write_text("old")
    folder.stages |= {name: StageRecord(name, "", finished=True) for name in ("capture", "truth", "references")}
    pipeline_stage(run)
    for content, noticed in (("old", False), ("new", True)):
        (folder.capture / "journal.bin").write_text(content)
        caplog.clear()
        with pytest.raises(Scored):
            score_stages(run)
        assert ("since the latest reconstruct" in caplog.text) is noticed


def test_the_closure_holds_what_is_imported_in_functions_and_the_packages_on_the_way() -> None:
    found = import_closure("disco_twin.experiment.experiment")
    assert {"disco_twin.light.transport", "pipeline.plan.plan", "disco_twin.light", "hw"} <= {*found}
    assert "disco_twin.scene.scene" not in found  # for type checking alone
    assert {"pipeline.reconstruct.baselines.dipole"} <= {*import_closure("pipeline.reconstruct")}
    light = " ".join(import_closure("disco_twin.light", "disco_twin.scene.scene"))
    assert "evaluate" not in light  # what `disco_twin.open_run` imports is no part of the simulated light
    assert "pipeline.model" not in light


def test_scores_of_other_methods_are_other_scores(folder: RunFolder) -> None:
    one, two = keys_of(folder), keys_of(folder, ("default", "dipole"))
    assert {name for name in ALL if one[name] != two[name]} == {"pipeline", "scores"}
    folder.stages = {n: StageRecord(n, one[n], finished=True) for n in ALL}  # the same pipeline run, scored anew
    run = Recorded(sphere(), folder, folder.scene_file, ("dipole",), QUIET)
    with pytest.raises(Scored):
        score_stages(run)
    assert folder.stages["scores"].key != one["scores"]


def test_what_old_code_left_is_not_continued(folder: RunFolder) -> None:
    left = {
        "capture": [folder.capture / name for name in ("images.bin", "journal.bin", "plan.json")],
        "spots": [folder.twin / "responses" / "spots-1.npy"],
        "references": [folder.twin / "references" / "uniform@left.exr"],
        "targets": [folder.capture / "calibration" / "front" / name for name in ("images.bin", "bracket/images.bin")],
    }
    kept = [folder.capture / "scan.ply", folder.work / "model-default.npz", folder.capture / "rig.json"]
    for stage, files in left.items():
        drop_outdated(folder, stage, "a")
        for path in files + kept:
            path.parent.mkdir(exist_ok=True, parents=True)
            path.write_bytes(b"x")
        drop_outdated(folder, stage, "a")
        assert all(path.exists() for path in files)
    for stage, files in left.items():
        drop_outdated(folder, stage, "b")
        assert not any(path.exists() for path in files)
        others = [
            path for name, paths in left.items() if list(left).index(name) > list(left).index(stage) for path in paths
        ]
        assert all(path.exists() for path in others + kept)


def test_stored_spots_belong_to_object_cameras_and_beam() -> None:
    activate()
    from disco_twin.light.response import light_key

    def key(experiment: Experiment, seed: int = 0, scale: float = 1.0, **medium: object) -> str:
        obj, rig = experiment.object, experiment.scene.rig
        mesh = obj.mesh.copy()
        mesh.vertices = np.asarray(mesh.vertices) * scale
        obj = replace(obj, mesh=mesh, medium=replace(obj.medium, **medium))  # type: ignore[arg-type]
        return light_key(obj, rig, actual_rig(rig, seed))

    same = sphere()
    medium, camera = same.object.medium, same.scene.rig.cameras[0].model_dump()
    assert key(same) == key(sphere())
    others = [
        key(same, scale=1.01),
        key(same, albedo=medium.albedo * np.float32(0.99)),
        key(same, sigma_t=medium.sigma_t * np.float32(1.01)),
        key(same, g=tuple(0.5 for _ in medium.g)),
        key(sphere(cameras=[camera | {"focal_length_mm": 30.0}])),
        key(sphere(cameras=[camera | {"aim_mm": (0.0, 0.0, 1.0)}])),
        key(sphere(turntable_angles_deg=(0.0, 90.0))),
        key(sphere(projector={"beam_diameter_mm": 1.0})),
        key(sphere(projector={"beam_profile": "gaussian"})),
        key(sphere(projector={"full_angle_deg": 11.0})),
        key(sphere(faults={"deviation": True})),
        key(sphere(faults={"deviation": True}), seed=1),
    ]
    assert len({key(same), *others}) == len(others) + 1


def test_a_run_warns_of_cameras_that_do_not_see_the_whole_object(
    folder: RunFolder, caplog: pytest.LogCaptureFixture
) -> None:
    """In `run`, in the report's notes; whole objects give neither."""
    experiment = sphere()
    with caplog.at_level(logging.WARNING):
        capture_stages(Recorded(experiment, folder, folder.scene_file, ("default",), QUIET))
    said = [record.getMessage() for record in caplog.records]
    assert [line.split(" does not see the whole object")[0] for line in said] == [
        "the camera 'a'",
        "the held-out view 'b'",
        "the held-out view 'c'",
    ]
    assert notes(experiment)[1:] == [f"T{line[1:]}." for line in said]
    camera = experiment.scene.rig.cameras[0].model_copy(update={"focal_length_mm": 2.0})
    scene = experiment.scene
    wide = Experiment(
        scene.model_copy(
            update={
                "rig": scene.rig.model_copy(update={"cameras": (camera,)}),
                "relight": scene.relight.model_copy(update={"views": (camera, camera)}),
            }
        )
    )
    assert wide.warnings == ()
    assert len(notes(wide)) == 1
