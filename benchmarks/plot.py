"""`python -m benchmarks.plot FILE.json PICTURE.svg`: the curves of a benchmark, error against seconds."""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path

ENDING = re.compile(r"^(.*): (.*), decade (-?\d)$")


def plot(record: Path, picture: Path) -> None:
    """One row of panels for each quantity, one panel for each decade, one line an estimator."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams |= {"svg.hashsalt": "disco-twin", "svg.fonttype": "none"}
    from matplotlib import pyplot, ticker

    found: dict[str, dict[int, dict[str, list[tuple[float, float]]]]] = {}
    for curve in json.loads(record.read_text())["curves"]:
        match = ENDING.match(curve["name"])
        if match:
            title, estimator, decade = match[1], match[2], int(match[3])
            points = [(p["seconds"], p["error"]) for p in curve["points"]]
            found.setdefault(title, {}).setdefault(decade, {})[estimator] = points
    columns = max(len(decades) for decades in found.values())
    figure, axes = pyplot.subplots(
        len(found), columns, figsize=(3 * columns, 2.8 * len(found)), squeeze=False, sharex="row", sharey="row"
    )
    for row, (title, decades) in zip(axes, found.items(), strict=True):
        for panel in row[len(decades) :]:
            panel.set_axis_off()
        for panel, (decade, estimators) in zip(row, sorted(decades.items(), reverse=True), strict=False):
            for estimator, points in estimators.items():
                panel.loglog(*zip(*points, strict=True), label=estimator, linewidth=1.0, marker="o", markersize=2.5)
            panel.set_title(f"{title}, decade {decade}", fontsize=8)
            panel.set_xlabel("processor seconds", fontsize=7)
            panel.set_ylabel("relative error", fontsize=7)
            panel.tick_params(labelsize=7)
            panel.xaxis.set_minor_formatter(ticker.NullFormatter())
            panel.yaxis.set_minor_formatter(ticker.NullFormatter())
        row[0].legend(fontsize=6)
    figure.tight_layout()
    figure.savefig(picture, metadata={"Date": None})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="The curves of a benchmark as a picture.")
    parser.add_argument("record", type=Path)
    parser.add_argument("picture", type=Path)
    options = parser.parse_args()
    plot(options.record, options.picture)
