"""The figures that the quick scene must reach, calibrated from its own images, on the run that `make demo` makes."""

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


@pytest.fixture(scope="module")
def summary(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """summary.json of a whole run of quick.toml, with the seconds that the command took."""
    out = tmp_path_factory.mktemp("quick") / "out"
    command = "from disco_twin.cli import main; main()"
    start = time.perf_counter()
    scene = repository / "scenes" / "quick.toml"
    subprocess.run([sys.executable, "-c", command, "run", str(scene), "--out", str(out)], check=True, timeout=1500)
    made: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return {**made, "command_seconds": time.perf_counter() - start}


def errors(summary: dict[str, Any], method: str) -> dict[tuple[str, str], float]:
    """nrmse by (light, view)."""
    return {(r["light"], r["view"]): r["nrmse"] for r in summary["relit"] if r["method"] == method}


def test_relit_images_meet_the_references(summary: dict[str, Any]) -> None:
    """At most .12 on broad lights and .17 at a shadow edge, in every held-out view, with all faults of the rig on."""
    for (light, view), error in errors(summary, "default").items():
        if light in BROAD:
            assert error <= 0.12, (light, view)
        if light == "edge":
            assert error <= 0.17, (light, view)


def test_energy_is_right_on_broad_lights(summary: dict[str, Any]) -> None:
    """Within 5 %."""
    for row in summary["relit"]:
        if row["method"] == "default" and row["light"] in BROAD:
            assert abs(row["energy_ratio"] - 1) <= 0.05, row


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
