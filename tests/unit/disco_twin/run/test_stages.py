"""A stage is done again when what it depends on has changed, the code included; old light is never continued."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from scene_fakes import sphere

from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.run_folder import RunFolder, StageRecord
from disco_twin.faults.actual_rig import actual_rig
from disco_twin.light.backend import activate
from disco_twin.run import stages
from disco_twin.run.progress import Report
from disco_twin.run.stages import Run, capture_stages, drop_old_light, pipeline_stage, score_stages, truth_stages
from pipeline.records import PipelineRecord


class Scored(Exception):
    """Ends `score_stages` after the stage's key is known."""


@dataclass(frozen=True)
class Recorded(Run):
    """Notes the stages' keys instead of doing them."""

    keys: dict[str, str] = field(default_factory=dict)

    def stage(self, name: str, key: str, work: Callable[[Report], Any], unit: str = "") -> None:
        self.keys[name] = key
        if name == "scores":
            raise Scored


def keys_of(folder: RunFolder, methods: tuple[str, ...] = ("default",)) -> dict[str, str]:
    run = Recorded(sphere(), folder, folder.scene_file, methods, Console(quiet=True))
    capture_stages(run)
    truth_stages(run)
    pipeline_stage(run)
    folder.stages = {n: StageRecord(n, key, finished=True) for n, key in run.keys.items()}
    with pytest.raises(Scored):
        score_stages(run)
    return run.keys


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    done = PipelineRecord(format_version=1, stages=(), methods={}, capture={}, left_out=(), warnings=())
    monkeypatch.setattr(stages, "load_results", lambda folder: done)
    monkeypatch.setattr(stages, "stale", lambda *_: None)
    scene = tmp_path / "scene.toml"
    scene.write_text("")
    return RunFolder.claim(tmp_path / "out", scene, "one")


ALL = {"scan", "capture", "truth", "references", "pipeline", "scores"}


@pytest.mark.parametrize(
    ("package", "again"),
    [
        *((f"disco_twin.{part}", ALL) for part in ("object", "light", "camera", "emulation.twin_rig", "faults")),
        ("hw", {"pipeline", "scores"}),
        ("pipeline", {"pipeline", "scores"}),
        ("disco_twin.evaluate.scores", {"scores"}),
        ("disco_twin.report.page", set()),
    ],
)
def test_changed_code_does_its_stages_again(
    package: str, again: set[str], folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, source_key = keys_of(folder), stages.source_key
    monkeypatch.setattr(stages, "source_key", lambda name: "changed" if name == package else source_key(name))
    after = keys_of(folder)
    assert set(before) == ALL
    assert {name for name in ALL if before[name] != after[name]} == again


def test_scores_of_other_methods_are_other_scores(folder: RunFolder) -> None:
    one, two = keys_of(folder), keys_of(folder, ("default", "dipole"))
    assert {name for name in ALL if one[name] != two[name]} == {"pipeline", "scores"}
    folder.stages = {n: StageRecord(n, one[n], finished=True) for n in ALL}  # the same pipeline run, scored anew
    run = Recorded(sphere(), folder, folder.scene_file, ("dipole",), Console(quiet=True))
    with pytest.raises(Scored):
        score_stages(run)
    assert run.keys["scores"] != one["scores"]


def test_old_light_goes_when_its_code_changed(folder: RunFolder) -> None:
    drop_old_light(folder, "a")
    light = [folder.capture / name for name in ("images.bin", "journal.bin", "plan.json")]
    light += [folder.twin / "responses" / "spots-1.npy", folder.twin / "references" / "uniform@left.exr"]
    kept = [folder.capture / "scan.ply", folder.work / "model-default.npz"]
    for path in light + kept:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"x")
    drop_old_light(folder, "a")
    assert all(path.exists() for path in light + kept)
    drop_old_light(folder, "b")
    assert not any(path.exists() for path in light)
    assert all(path.exists() for path in kept)


def test_stored_spots_belong_to_object_cameras_and_beam() -> None:
    activate()
    from disco_twin.light.response import light_key

    def key(world: Experiment, seed: int = 0, scale: float = 1.0, **medium: object) -> str:
        obj, rig = world.object, world.scene.rig
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
