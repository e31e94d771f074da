"""Methods that are reconstructed one after another stand beside each other in summary and report."""

from __future__ import annotations

from pathlib import Path

import pytest
from frozen_run import write_frozen_run
from rich.console import Console

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
