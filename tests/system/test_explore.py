"""docs/howto/explore.md as it stands, on a small run in the place of the demo's."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

from frozen_run import write_frozen_run
from view_models import model_on

from disco_twin.evaluate.opened_run import OpenedRun


def test_the_page_runs(repository: Path, tmp_path: Path) -> None:
    """Its model is one with directions; its own method meets R_d, which falls exponentially there."""
    root = tmp_path / "out" / "quick"
    root.parent.mkdir()
    write_frozen_run(root)
    run = OpenedRun(root)
    model_on(run.experiment.scan).save(run.folder.work / "model-default.npz")
    made = json.loads((run.folder.work / "pipeline.json").read_text())
    made["methods"]["default"] = made["methods"]["lambertian"]
    (run.folder.work / "pipeline.json").write_text(json.dumps(made))
    page = (repository / "docs" / "howto" / "explore.md").read_text()
    code = "\n".join(re.findall(r"```python\n(.*?)```", page, re.S))
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=200, check=False,
        env=os.environ | {"PYTHONPATH": str(repository), "MPLBACKEND": "Agg"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "column.png").stat().st_size > 5000
    assert float(re.findall(r"differs by ([\d.e-]+)", done.stdout)[0]) < 0.01
    shown = [float(x) for x in re.findall(r"rms error ([\d.]+)", done.stdout)]
    assert len(shown) == 4
    assert max(shown) < 0.2
