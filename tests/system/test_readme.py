"""The README's Python examples run as they stand."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from frozen_run import write_frozen_run


def example(repository: Path, number: int, folder: Path) -> str:
    """What one of the examples prints when it is run in a folder."""
    code = re.findall(r"```python\n(.*?)```", (repository / "README.md").read_text(), re.S)[number]
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(repository)!r})\n{code}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_twin_answers_a_question(repository: Path) -> None:
    assert example(repository, 0, repository).count("1/mm^2") == 4


def test_a_run_folder_opens_as_arrays(repository: Path, tmp_path: Path) -> None:
    """On a small run folder in the place of the demo's."""
    (tmp_path / "out").mkdir()
    write_frozen_run(tmp_path / "out" / "quick")
    printed = example(repository, 1, tmp_path)
    assert re.search(r"brightest pixel: [\d.e-]+ W mm-2 sr-1", printed)
    assert printed.count("mm-2") == 3
    assert re.search(r"uniform +[\d.]+ +[\d.]+", printed)
