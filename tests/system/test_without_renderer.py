"""`hw`, `pipeline` and the commands that need no renderer work where mitsuba and drjit are not installed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from blocked_renderer import BLOCK


def without_renderer(code: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", BLOCK + code], capture_output=True, text=True, timeout=120, check=False, cwd=cwd
    )


def test_every_module_of_hw_and_pipeline_imports(repository: Path) -> None:
    done = without_renderer(
        "import importlib, pkgutil, hw, pipeline\n"
        "names = [m.name for p in (hw, pipeline) for m in pkgutil.walk_packages(p.__path__, p.__name__ + '.')\n"
        "         if not m.name.endswith('__main__')]\n"
        "for name in names: importlib.import_module(name)\n"
        "print(len(names)); assert 'disco_twin' not in sys.modules",
        repository,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 20


@pytest.mark.parametrize("command", [["plan", "scenes/quick.toml"], ["--help"], ["run", "--help"]])
def test_commands_that_need_no_renderer(command: list[str], repository: Path) -> None:
    done = without_renderer(f"from disco_twin.cli.app import main; main({command!r})", repository)
    assert done.returncode == 0, done.stderr
    assert done.stdout


def test_doctor_and_run_say_what_is_missing(repository: Path, tmp_path: Path) -> None:
    arguments = ["capture", "scenes/slab.toml", "--out", str(tmp_path / "o")]
    code = f"from disco_twin.cli.app import main; main({arguments!r})"
    done = without_renderer(code, repository)
    assert done.returncode == 2
    assert "the renderer is not installed" in done.stderr
    assert "Remedy: pip install" in done.stderr
    assert "Traceback" not in done.stderr
