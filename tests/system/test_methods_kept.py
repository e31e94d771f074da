"""Methods that are reconstructed one after another stand beside each other in summary and report."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from frozen_run import write_frozen_run
from refusals import Says
from rich.console import Console

from disco_twin.cli.app import main
from disco_twin.experiment.pipeline_process import load_results
from disco_twin.run.stages import pipeline_stage, reopen_run, score_stages

QUIET = Console(quiet=True)
BASELINES = {"dipole", "lambertian"}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose pipeline has made the default, and then been asked for another method."""
    out = tmp_path_factory.mktemp("kept") / "out"
    write_frozen_run(out)
    pipeline_stage(reopen_run(out, "default", QUIET))
    return out


def test_a_method_that_is_added_hides_no_other(root: Path) -> None:
    """`reconstruct --methods disco2004`, then `score`: all are scored, and what was there is not made again."""
    model = root / "work" / "model-default.npz"
    before, made = model.stat(), set(load_results(reopen_run(root, None, QUIET).folder).methods)
    assert made == {"default"} | BASELINES
    run = reopen_run(root, "disco2004", QUIET)
    pipeline_stage(run)
    assert model.stat().st_mtime_ns == before.st_mtime_ns
    found = load_results(run.folder)
    assert set(found.methods) == made | {"disco2004"}
    assert all(own.seconds > 0 for own in found.methods.values())
    for methods, first in (("disco2004", "disco2004"), (None, "dipole")):  # the scene's own is the dipole
        summary = score_stages(reopen_run(root, methods, QUIET))
        assert summary["method"] == first == summary["relit"][0]["method"]
        assert {row["method"] for row in summary["relit"]} == made | {"disco2004"}
    page = (root / "report.html").read_text()
    assert "disco2004" in page and "default" in page
    record = run.folder.stages["pipeline"]
    pipeline_stage(reopen_run(root, "default,disco2004", QUIET))
    assert reopen_run(root, None, QUIET).folder.stages["pipeline"].seconds == record.seconds  # finished before


def test_models_of_other_settings_do_not_stay(root: Path) -> None:
    """Rationale: a scene whose [reconstruct] has changed: what was made before is of other settings."""
    run = reopen_run(root, "lambertian", QUIET)
    own = run.scene.reconstruct.model_copy(update={"highlight_deg": 12.0})
    vars(run.experiment)["scene"] = run.scene.model_copy(update={"reconstruct": own})
    pipeline_stage(run)
    assert set(load_results(run.folder).methods) == BASELINES


def test_two_methods_are_compared(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """On one capture, and that of a copy: a table with standard errors, a plot, and nothing between equals."""
    plot, copy = tmp_path / "differences.svg", tmp_path / "copy"
    with pytest.raises(SystemExit) as ended:
        main(["compare", str(root), str(root), "--methods", "dipole,lambertian", "--plot", str(plot)])
    assert ended.value.code == 0
    table = capsys.readouterr().out
    assert "relit/directional@left nrmse" in table and "spots/place mm" in table
    assert "completion" not in table  # the Lambertian one states no R_d
    assert "worse" in table
    assert "<svg" in plot.read_text()
    shutil.copytree(root, copy)
    with pytest.raises(SystemExit):
        main(["compare", str(root), str(copy), "--methods", "dipole"])
    same = capsys.readouterr().out
    assert "completion/decade 0 log10 rmse" in same
    assert "worse" not in same.replace("more is worse", "") and "better" not in same


def test_what_cannot_be_compared_is_refused(root: Path, tmp_path: Path, says: Says) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(root, copy)
    plan = copy / "capture" / "plan.json"
    plan.write_text(plan.read_text() + " ")
    assert "plan.json differs" in says("compare", root, copy, "--methods", "dipole")
    assert "model-nonesuch.npz" in says("compare", root, root, "--methods", "nonesuch")
    assert "--plot" in says("compare", root, root, "--methods", "dipole", "--plot", tmp_path / "x.txt")
    assert "--methods" in says("compare", root, root, "--methods", "a,b,c")
    assert "no run folder" in says("compare", root, tmp_path)
