"""The figures that the quick scene must reach, on the run that `make demo` makes, and before an ideal rig."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

BROAD = ("uniform", "directional", "environment")


def run(repository: Path, folder: Path, *options: str) -> dict[str, Any]:
    """summary.json of a whole run of quick.toml, with the seconds that the command took."""
    out, scene = folder / "out", repository / "scenes" / "quick.toml"
    command = [sys.executable, "-c", "from disco_twin.cli.app import main; main()", "run", str(scene)]
    command += ["--out", str(out)]
    start = time.perf_counter()
    subprocess.run([*command, *options], check=True, timeout=1500)
    made: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return {**made, "command_seconds": time.perf_counter() - start}


@pytest.fixture(scope="module")
def summary(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Calibrated from its own images, with all faults of the rig on."""
    return run(repository, tmp_path_factory.mktemp("quick"))


@pytest.fixture(scope="module")
def ideal(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The rig stands as its configuration says: what is left is the method's own error."""
    return run(repository, tmp_path_factory.mktemp("ideal"), "--no-faults")


def errors(summary: dict[str, Any], method: str) -> dict[tuple[str, str], float]:
    """nrmse by (light, view)."""
    return {(r["light"], r["view"]): r["nrmse"] for r in summary["relit"] if r["method"] == method}


def test_relit_images_meet_the_references(summary: dict[str, Any]) -> None:
    """At most .12 on broad lights and .17 at a shadow edge, in every held-out view."""
    for (light, view), error in errors(summary, "default").items():
        if light in BROAD:
            assert error <= 0.12, (light, view)
        if light == "edge":
            assert error <= 0.17, (light, view)


def test_relit_images_meet_the_references_better_without_faults(ideal: dict[str, Any]) -> None:
    """At most .10 on broad lights, their energy within 5 %, and .15 at a shadow edge, in every held-out view."""
    for (light, view), error in errors(ideal, "default").items():
        if light in BROAD:
            assert error <= 0.10, (light, view)
        if light == "edge":
            assert error <= 0.15, (light, view)
    for row in ideal["relit"]:
        if row["method"] == "default" and row["light"] in BROAD:
            assert abs(row["energy_ratio"] - 1) <= 0.05, row


def test_the_rig_is_calibrated_from_its_own_images(summary: dict[str, Any], ideal: dict[str, Any]) -> None:
    """Reprojection at most .15 px, focal lengths known within .2 %; an ideal rig needs no calibration."""
    for lens in summary["calibration"]["lenses"]:
        assert lens["reprojection_px"] <= 0.15
        assert lens["focal_error_px"] <= 0.002 * lens["focal_px"]
    assert (summary["calibration"]["source"], ideal["calibration"]["source"]) == ("measured", "nominal")


def test_measured_reflectance_meets_the_truth(summary: dict[str, Any]) -> None:
    """log10 rmse at most .15 in the decades 0 and -1, at least half of their entries measured."""
    for decade in ("0", "-1"):
        assert summary["reflectance"]["log10_rmse_by_decade"][decade] <= 0.15
        assert summary["reflectance"]["coverage_by_decade"][decade] >= 0.5


def test_the_default_beats_the_simple_models(summary: dict[str, Any]) -> None:
    """Better than the dipole under every light (views together), twice as good as the Lambertian from behind."""

    def together(method: str, light: str) -> float:
        squares = [e * abs(e) for (name, _), e in errors(summary, method).items() if name == light]
        return float(sum(squares) / len(squares)) ** 0.5

    for light in {light for light, _ in errors(summary, "default")}:
        assert together("default", light) < together("dipole", light), light
    assert 2 * together("default", "behind") <= together("lambertian", "behind")


def test_memory_stays_below_six_gigabytes(summary: dict[str, Any]) -> None:
    """The seconds are the machine's; six minutes on two idle cores are asked for, and twice that is allowed here."""
    assert max(s["peak_mb"] for s in summary["stages"]) < 6000
    assert summary["command_seconds"] < 720
