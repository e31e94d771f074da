"""The whole path, from a scene to scores, on a shrunken quick scene: `disco-twin run` as a user runs it."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

# Two lights instead of seven, half of the spots, a scan of 300 vertices; `--profile small` shrinks what is left.
SHRINK = """
[simulation]
walks_per_spot = 30_000
truth_columns = 16
truth_walks = 100_000
reference_noise = 0.2

[relight]
lights = ["uniform", "directional"]

"""


def disco_twin(*arguments: object) -> subprocess.Popen[str]:
    code = "from disco_twin.cli.app import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def finish(process: subprocess.Popen[str], timeout_s: float = 240) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=timeout_s)
    return process.returncode, out, err


@pytest.fixture(scope="module")
def scene(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    text = (repository / "scenes" / "quick.toml").read_text()
    text = re.sub(r"\[simulation\]\n(?:[^\[\n].*\n|\n)*", "", text)
    text = text.replace("[[relight.views]]", SHRINK + "[[relight.views]]", 1).replace("vertices = ", "vertices = 300 #")
    text = text.replace("spots = 300", "spots = 160", 1)
    path = tmp_path_factory.mktemp("scene") / "small.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def run_folder(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that is interrupted twice by Ctrl-C and once killed, and still ends well."""
    out = tmp_path_factory.mktemp("run") / "out"
    images = out / "capture" / "images.bin"
    for number, expected in ((signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)):
        before = images.stat().st_size if images.exists() else 0
        process = disco_twin("run", scene, "--out", out, "--profile", "small")
        deadline = time.monotonic() + 120
        while not (images.exists() and images.stat().st_size > before + 20_000) and process.poll() is None:
            assert time.monotonic() < deadline, "the capture does not start"
            time.sleep(0.02)
        os.kill(process.pid, number)
        status, _, err = finish(process)
        assert status == expected, err
        assert number == signal.SIGKILL or "same command continues" in err
    status, _, err = finish(disco_twin("run", scene, "--out", out, "--profile", "small"))
    assert status == 0, err
    return out


@pytest.fixture(scope="module")
def summary(run_folder: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((run_folder / "summary.json").read_text())
    return loaded


def test_summary_has_exactly_what_the_design_says(summary: dict[str, Any]) -> None:
    assert set(summary) == {
        "format_version", "scene", "seed", "method", "stages", "capture", "calibration", "simulation_noise", "relit",
        "z", "reflectance", "left_out",
    }  # fmt: skip
    assert summary["format_version"] == 1
    assert (summary["scene"], summary["seed"], summary["method"]) == ("quick", 1, "default")
    assert {"name", "seconds", "peak_mb"} == set(summary["stages"][0])
    names = [s["name"] for s in summary["stages"]]
    assert names[:5] == ["scan", "targets", "capture", "truth", "references"]
    assert all(s["seconds"] > 0 and 10 < s["peak_mb"] < 8000 for s in summary["stages"])
    capture = summary["capture"]
    assert (capture["views"], capture["spots"], capture["wavelengths"]) == (6, 40, 3)
    assert capture["images"] == 6 + 2 * 3 * 40
    assert 0 < capture["bytes_stored"] < capture["bytes_raw"]
    for key in ("log10_rmse_by_decade", "log10_rmse_all_by_decade", "coverage_by_decade"):
        assert set(summary["reflectance"][key]) == {"0", "-1", "-2", "-3"}
    totals = summary["reflectance"]["totals"]
    assert totals["lit"]["columns"] + totals["unlit"]["columns"] == 4
    assert [len(totals[part][key]) for part in totals for key in ("mean", "mean_se", "spread", "spread_se")] == [3] * 8
    assert set(summary["z"]) == {"entries", "totals", "slopes", "pixels"}
    slopes = summary["reflectance"]["slopes"]
    assert len(slopes["distance_mm"]) == len(slopes["truth"]) == len(slopes["model"]) == summary["z"]["slopes"]["count"]
    assert all(0 < z["rms"] < 100 for z in summary["z"]["pixels"]["uniform"].values())
    assert all(set(item) == {"what", "because"} for item in summary["left_out"])


def test_every_light_view_and_method_is_scored(summary: dict[str, Any]) -> None:
    rows = summary["relit"]
    assert {(r["light"], r["view"], r["method"]) for r in rows} == {
        (light, view, method)
        for light in ("uniform", "directional")
        for view in ("left", "right")
        for method in ("default", "disco2004", "dipole", "lambertian")
    }
    for row in rows:
        assert np.isfinite(row["nrmse"])
        assert row["nrmse_se"] >= 0
        assert row["rim_nrmse_se"] is None or row["rim_nrmse_se"] >= 0


def test_the_default_method_relights_and_beats_the_lambertian(summary: dict[str, Any]) -> None:
    """Loose: a quarter of the pixels, few spots, vertices and photons. The full figures are the demo's."""
    errors = {(r["light"], r["view"], r["method"]): r["nrmse"] for r in summary["relit"]}
    for (light, view, method), error in errors.items():
        if method == "default":
            assert error < 0.3, (light, view)
            if light == "directional":
                assert error < errors[light, view, "lambertian"]


def test_the_pipeline_was_kept_from_the_truth(run_folder: Path) -> None:
    given = {p.name for p in (run_folder / "capture").iterdir()}
    assert not [name for name in given if "truth" in name or name.endswith(".exr")]
    twin = str(run_folder / "twin")
    assert not [p for p in (run_folder / "work").rglob("*.json") if twin in p.read_text()]


def test_a_finished_run_is_not_repeated(run_folder: Path, scene: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in (run_folder / "capture").iterdir()}
    status, out, err = finish(disco_twin("run", scene, "--out", run_folder, "--profile", "small"))
    assert status == 0, err
    assert out.count("finished before") == 7
    assert before == {p: p.stat().st_mtime_ns for p in (run_folder / "capture").iterdir()}


def test_the_interrupted_capture_equals_an_uninterrupted_one(run_folder: Path, scene: Path, tmp_path: Path) -> None:
    status, _, err = finish(disco_twin("capture", scene, "--out", tmp_path / "out", "--profile", "small"))
    assert status == 0, err
    for name in ("images.bin", "journal.bin", "plan.json", "scan.ply", "rig.json"):
        assert (tmp_path / "out" / "capture" / name).read_bytes() == (run_folder / "capture" / name).read_bytes()


def test_the_report_is_there(run_folder: Path) -> None:
    page = (run_folder / "report.html").read_text()
    assert "<h3>directional</h3>" in page
    assert page.count("<img") == 2 + 7
    assert (run_folder / "scene.toml").is_file()
    assert "Mitsuba" in (run_folder / "run.log").read_text()
