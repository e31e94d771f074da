"""`python -m benchmarks.readme_picture RUN FILE.png`: the README's picture, from a finished run."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from disco_twin.report.collect import comparisons, impulses
from disco_twin.report.figures import Comparison, Impulse, new_figure, plain, tone
from disco_twin.run.stages import reopen_run
from pipeline.calibrate.calibration import Calibration

LIGHTS = ("directional", "edge", "behind", "projector")


def picture_figure(spots: Sequence[Impulse], comparisons: Sequence[Comparison], method: str) -> Figure:
    """The README's picture: two recorded spots on a log scale, then relit above reference for some lights."""
    columns = 1 + len(comparisons)
    figure, axes = new_figure(2.0 * columns, 2.85, nrows=2, ncols=columns)
    for axis, spot, name in zip(
        axes[:, 0], spots, ("captured: a laser spot (log scale)", "the same spot from behind"), strict=False
    ):
        shown = np.log10(np.maximum(spot.radiance, spot.radiance.max() * 1e-5))
        axis.imshow(shown, cmap="magma")
        axis.set_title(name, loc="left", fontsize=8)
    for column, row in zip(axes[:, 1:].T, comparisons, strict=True):
        exposure = float(np.percentile(row.reference[:, row.mask], 99))
        for axis, image, name in zip(column, (row.relit[method], row.reference), ("relit", "Mitsuba"), strict=True):
            axis.imshow(tone(image, exposure, len(image)))
            axis.set_title(f"{name}: {row.light}", loc="left", fontsize=8)
    for axis in axes.flat:
        plain(axis)
    return figure


def main(run: Path, target: Path) -> None:
    """Draw the picture of a run folder."""
    from rich.console import Console

    opened = reopen_run(run, None, Console())
    summary = json.loads(opened.folder.summary_file.read_text())
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
