"""`disco-twin score` on a run whose files have suffered since: one line names the file, and how to make it again."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from frozen_run import write_frozen_run
from refusals import Says
from rich.console import Console

from disco_twin.run.stages import pipeline_stage, reopen_run


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("finished") / "out"
    write_frozen_run(root)
    pipeline_stage(reopen_run(root, "lambertian", Console(quiet=True)))
    return root


def cut(share: float) -> Callable[[Path], None]:
    return lambda path: os.truncate(path, int(share * path.stat().st_size))


def change(key: str, value: object) -> Callable[[Path], None]:
    def edit(path: Path) -> None:
        data = json.loads(path.read_text())
        data[key] = value
        path.write_text(json.dumps(data))

    return edit


@pytest.mark.parametrize(
    ("name", "damage", "says_so"),
    [
        ("capture/images.bin", cut(0.4), "images.bin"),
        ("capture/plan.json", cut(0.4), "plan.json: is damaged"),
        ("work/samples.npz", cut(0.4), "samples.npz: is damaged"),
        ("work/samples.npz", Path.unlink, "samples.npz: is missing"),
        ("work/calibration.json", cut(0.4), "calibration.json: is damaged"),
        ("work/calibration.json", change("sensor", {"bits": 17}), "calibration.json: sensor"),
        ("work/model-lambertian.npz", cut(0.4), "model-lambertian.npz: is damaged"),
        ("twin/truth.npz", cut(0.4), "truth.npz: is damaged"),
        ("twin/moments.npz", Path.unlink, "moments.npz: is missing"),
    ],
)
def test_a_damaged_file_is_named_with_what_makes_it_again(
    finished: Path, tmp_path: Path, says: Says, name: str, damage: Callable[[Path], object], says_so: str
) -> None:
    root = tmp_path / "out"
    shutil.copytree(finished, root)
    damage(root / name)
    line = says("score", "--out", root, "--methods", "lambertian")
    assert says_so in line and str(root / name) in line
    remedy = line.partition("Remedy: ")[2]
    assert any(words in remedy for words in ("disco-twin run", "reconstruct again", "capture")), remedy
