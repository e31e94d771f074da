"""`disco-twin budget`, whole: on a run of known R_d, and on a shrunken quick scene with all faults."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from frozen_run import write_frozen_run
from refusals import Says
from rich.console import Console
from scipy.optimize import brentq
from significance import threshold

from disco_twin.cli.app import main
from disco_twin.evaluate import exact_light
from disco_twin.evaluate.true_calibration import VARIANTS
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.run.budget import make, rows
from disco_twin.run.budget.job_rows import JobRows
from disco_twin.run.budget.light_rows import LightRows
from disco_twin.run.budget.make import RECORD, make_budget
from disco_twin.run.stages import Run, begin_run, reopen_run, run_all
from pipeline.capture.loop import Interrupted
from pipeline.geometry.fresnel import Boundary
from pipeline.relight.scores import signed_root

QUIET = Console(quiet=True)
OF_LIGHT = {rows.EXACT_ENTRY, rows.EXACT_EXIT, rows.SMOOTH, rows.FLOOR, rows.LUMPED, rows.CONSISTENT, rows.TRUE_MODEL}
ALWAYS = OF_LIGHT | {rows.EXACT_SAMPLES, rows.MEASURED, rows.QUIET}
WALKS = 4000


@pytest.fixture(scope="module")
def frozen(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Two lights and views of a sphere, nominal calibration, no faults; little light."""
    root = tmp_path_factory.mktemp("frozen") / "out"
    write_frozen_run(root)
    scene = json.loads((root / "scene.json").read_text())
    scene["simulation"]["walks_per_spot"] = 200
    (root / "scene.json").write_text(json.dumps(scene))
    return reopen_run(root, "lambertian", QUIET)


@pytest.fixture(autouse=True)
def _few_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exact_light, "SAMPLE_WALKS", 400)


def groups(run: Run) -> set[str]:
    """Those that are kept."""
    return set(json.loads((run.folder.twin / RECORD).read_text())["groups"])


def never(*_: Any, **__: Any) -> Any:
    raise AssertionError("this was made before")


def test_a_budget_is_continued_kept_and_made_again_where_it_depends_on_what_changed(
    frozen: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Interrupted, continued, asked for again, shown, asked for with more light."""

    def stop(*_: Any) -> Any:
        raise KeyboardInterrupt

    screen = Console(file=io.StringIO(), width=100)
    with monkeypatch.context() as once:
        once.setattr(JobRows, "exact_samples", stop)
        with pytest.raises(Interrupted, match="stopped during budget; the same command continues"):
            make_budget(replace(frozen, console=screen), WALKS)
    lines = [line.split() for line in screen.file.getvalue().splitlines()]
    assert [line[:2] for line in lines] == [["1/6", "entry"], ["2/6", "ends"], ["3/6", "hats"]]
    assert all(float(line[2]) > 0 and line[3] == "s" for line in lines)
    assert groups(frozen) == {"entry", "ends", "hats"}

    light = ("exact_entry", "diffuse_ends", "true_model")
    with monkeypatch.context() as dark:
        for name in light:
            dark.setattr(LightRows, name, never)
        budget = make_budget(frozen, WALKS)
        assert {row.row for row in budget.rows} == ALWAYS
        relight = frozen.scene.relight
        where = {(row.light, row.view) for row in budget.rows}
        assert where == {(light.name, view.name) for light in relight.lights for view in relight.views}
        assert len(budget.rows) == len(ALWAYS) * len(where)
        assert all(row.nrmse is not None for row in budget.rows)
        assert set(budget.left_out) == {"calibration", "the scanner"}
        assert not any(p.is_dir() for p in (frozen.folder.twin / "budget").glob("*"))  # what it worked in is gone

        for name in ("exact_samples", "again", "relit", "quiet_camera"):
            dark.setattr(JobRows, name, never)
        assert make_budget(frozen, WALKS) == budget
        dark.setattr(make, "make_budget", lambda run: make_budget(run, WALKS))
        main_without_exit("budget", frozen.folder.root, "--method", "lambertian")
        said = " ".join(capsys.readouterr().out.split())
        for text in (*ALWAYS, rows.LEFT, *rows.COSTS):
            assert text in said
        assert "no row for the scanner: it has no error here" in said
        assert "need not add up in quadrature" in said

    made: list[str] = []

    def noted(name: str, rows: Any) -> Callable[..., Any]:
        return lambda *_: (made.append(name), rows)[1]

    for name in (*light, "quiet_camera"):
        monkeypatch.setattr(LightRows if name in light else JobRows, name, noted(name, {}))
    monkeypatch.setattr(LightRows, "diffuse_ends", noted("diffuse_ends", ({}, Boundary(1.3))))
    monkeypatch.setattr(JobRows, "exact_samples", noted("exact_samples", {}))
    make_budget(frozen, 2 * WALKS)
    assert made == [*light, "exact_samples"]


def main_without_exit(*words: object) -> None:
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in words])
    assert end.value.code == 0


def test_a_budget_is_refused_in_one_line(frozen: Run, tmp_path: Path, says: Says) -> None:
    """No run; a run that has not come to its end; a method that was not reconstructed; a record of another version."""
    assert "is no run folder" in says("budget", tmp_path)
    text, out = tmp_path / "scene.toml", tmp_path / "out"
    text.write_text("# frozen\n")
    begun = RunFolder.claim(out, text, "frozen")
    begun.scene_record.write_bytes(frozen.folder.scene_record.read_bytes())
    assert "the stage references is not finished" in says("budget", out)
    begun.run("references", "a", lambda: None)
    assert "the stage pipeline is not finished" in says("budget", out)
    refused = says("budget", frozen.folder.root, "--method", "default")
    assert "did not make default" in refused and "--methods default" in refused


def z_of_square(nrmse: float, nrmse_se: float) -> float:
    """nrmse^2 over its standard error, whose distribution is Gaussian at 0, too; nrmse_se is its effect on the root."""
    square = nrmse * abs(nrmse)

    def off(se: float) -> float:
        return 0.5 * (signed_root(square + se) - signed_root(square - se)) - nrmse_se

    return square / brentq(off, 0.0, 4.0 * (abs(nrmse) + nrmse_se) ** 2)


SHRINK = """
[simulation]
walks_per_spot = 20_000
truth_columns = 8
truth_walks = 20_000
reference_noise = 0.04

[relight]
lights = ["uniform", "directional"]

"""


@pytest.mark.slow
def test_every_row_of_a_scene_with_all_faults(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Expected behaviour: every part has its row; what was measured scores as in the summary; under uniform light,
    which enters from all around, a diffuse entry is exact, and the row of exact exits 0 within its error.
    """
    monkeypatch.setattr(exact_light, "SAMPLE_WALKS", 8000)
    text = (repository / "scenes" / "quick.toml").read_text()
    text = re.sub(r"\[simulation\]\n(?:[^\[\n].*\n|\n)*", "", text)
    text = text.replace("[[relight.views]]", SHRINK + "[[relight.views]]", 1).replace("vertices = ", "vertices = 300 #")
    scene = tmp_path / "small.toml"
    scene.write_text(text)
    run = begin_run(scene, tmp_path / "out", "small", "default", QUIET)
    summary = run_all(run)
    budget = make_budget(run, 200_000)
    assert {row.row for row in budget.rows} == ALWAYS | {rows.EXACT_SCAN, rows.NOMINAL, *VARIANTS}
    assert budget.left_out == {}
    assert all(budget.cost(part, light) is not None for part in (*rows.COSTS, rows.LEFT) for light in ("uniform",))
    scored = {(r["light"], r["view"]): r["nrmse"] for r in summary["relit"] if r["method"] == "default"}
    for row in budget.rows:
        assert row.nrmse is not None and row.nrmse_se is not None
        if row.row == rows.MEASURED:
            assert row.nrmse == pytest.approx(scored[row.light, row.view], rel=1e-4)
        if row.row == rows.EXACT_EXIT and row.light == "uniform":
            assert abs(z_of_square(row.nrmse, row.nrmse_se)) < threshold(2)
