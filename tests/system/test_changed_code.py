"""In a copy of the project whose code is changed, stages that import what changed are done again, and only those."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from disco_twin.light.truth import Truth

SCENE = """
format_version = 1
name = "sphere"
[object]
shape = { kind = "sphere" }
medium = { base = { kind = "homogeneous", sigma_t_per_mm = 1.0, albedo = 0.9 } }
[scan]
vertices = 100
[simulation]
walks_per_spot = 200
truth_columns = 2
truth_walks = 800
reference_noise = 0.5
[rig]
spots = 8
lasers = [{ wavelength_nm = 635.0 }]
cameras = [{ name = "a", position_mm = [450.0, 0.0, 50.0], width = 32, height = 32 }]
[relight]
views = [
    { name = "b", position_mm = [450.0, 0.0, 50.0], width = 32, height = 32 },
    { name = "c", position_mm = [450.0, 50.0, 50.0], width = 32, height = 32 },
]
lights = [{ kind = "uniform", name = "uniform", colour = [1.0] }]
"""
PROGRAM = """
from pathlib import Path
from rich.console import Console
from disco_twin.run.stages import begin_run, capture_stages, truth_stages
run = begin_run(Path("scene.toml"), Path("out"), "full", "default", Console())
capture_stages(run)
truth_stages(run)
"""
KEYS = r"""
import json
from pathlib import Path
from disco_twin.experiment import keys
from disco_twin.run.stages import CODE

WRAPPED = "\n\n_whole = {0}\n\n\ndef {0}(*given, **named):\n    return _whole(*given, **named)\n"

def found():
    keys.code_key.cache_clear()
    keys._imports.cache_clear()
    return {stage: keys.code_key(*modules) for stage, modules in CODE.items()}

every = [found()]
for module, function in CHANGES:
    with Path("disco_twin", module + ".py").open("a") as file:
        file.write(WRAPPED.format(function))
    every.append(found())
print(json.dumps(every))
"""
QUARTER = """

_whole = hat_areas


def hat_areas(transport, basis):
    return _whole(transport, basis) / 4
"""


@pytest.fixture
def project(tmp_path: Path, repository: Path) -> Path:
    for floor in ("hw", "pipeline", "disco_twin"):
        shutil.copytree(repository / floor, tmp_path / floor, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "scene.toml").write_text(SCENE)
    return tmp_path


def run_in(project: Path, program: str) -> str:
    """What a program prints that imports the copy."""
    environment = os.environ | {"PYTHONPATH": str(project)}
    command = [sys.executable, "-c", program]
    end = subprocess.run(command, cwd=project, env=environment, capture_output=True, text=True, check=False)
    assert end.returncode == 0, end.stderr
    return end.stdout


def stages_done(project: Path) -> set[str]:
    """Simulate in the copy; the stages that were not finished before."""
    return {line.split()[0] for line in run_in(project, PROGRAM).splitlines() if " MiB" in line}


@pytest.mark.slow
def test_truth_is_computed_again_when_what_it_imports_has_changed_and_only_then(project: Path) -> None:
    """Truth divides by the areas of hat functions: with a quarter of them, the truth of before is four times off."""
    truth = project / "out" / "twin" / "truth.npz"
    assert stages_done(project) == {"scan", "capture", "truth", "references"}
    before, captured = Truth.load(truth), (project / "out" / "capture" / "images.bin").stat()
    with (project / "disco_twin" / "light" / "truth.py").open("a") as file:
        file.write(QUARTER)
    assert stages_done(project) == {"truth"}
    np.testing.assert_allclose(Truth.load(truth).mean, 4 * before.mean, rtol=1e-6)
    for not_imported in ("disco_twin/report/page.py", "disco_twin/evaluate/summary.py", "pipeline/relight/scores.py"):
        with (project / not_imported).open("a") as file:
            file.write("CHANGED = True\n")
    assert stages_done(project) == set()
    assert (project / "out" / "capture" / "images.bin").stat() == captured


def test_a_changed_function_is_in_the_keys_of_the_stages_that_depend_on_it(project: Path) -> None:
    """By the keys of a stage's code alone, of which the stages' own are made; one function changed after the other."""
    changes = {  # by function, the stages that are done again
        ("camera/lars3", "lars3_sensor"): {"scan", "targets", "capture", "budget"},
        ("light/sources", "light_source"): {"scan", "spots", "capture", "truth", "references", "scores", "budget"},
        ("light/rendering", "render_reference"): {"references", "scores", "budget"},
    }
    before, *rest = json.loads(run_in(project, f"CHANGES = {list(changes)}\n{KEYS}"))
    for after, again in zip(rest, changes.values(), strict=True):
        assert again == {stage for stage in before if before[stage] != after[stage]}
        before = after
