"""The README's Python example runs as it stands."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path


def test_the_python_example_runs(repository: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (repository / "README.md").read_text(), re.S)
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True, text=True, timeout=200, check=False, cwd=repository,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("R_d") == 4
