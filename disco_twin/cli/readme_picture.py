"""`python -m disco_twin.cli.readme_picture RUN FILE.png`: the README's picture, from a finished run."""

from __future__ import annotations

import sys
from pathlib import Path

from disco_twin.evaluate.summary import load_summary
from disco_twin.report.collect import comparisons, impulses
from disco_twin.report.figures import picture_figure
from disco_twin.run.stages import reopen_run
from pipeline.calibrate.calibration import Calibration

LIGHTS = ("directional", "edge", "behind", "projector")


def main(run: Path, target: Path) -> None:
    """Draw the picture of a run folder."""
    from rich.console import Console

    opened = reopen_run(run, None, Console())
    summary = load_summary(opened.folder.summary_file)
    method = summary["method"]
    sensor = Calibration.load(opened.folder.work / "calibration.json").sensor
    spots = [row[0] for row in impulses(opened.scene.rig, opened.folder.capture, sensor)[0]]
    found = comparisons(opened.experiment, opened.folder, [method], summary["relit"])
    first = opened.scene.relight.views[0].name
    shown = [c for c in found if c.view == first and c.light in LIGHTS]
    figure = picture_figure(spots, shown, method)
    target.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(target, dpi=100, metadata={"Software": None})


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
