"""`python -m benchmarks.accuracy_picture FILE.jpg`: the objects of docs/accuracy.md, from their references."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.accuracy import set_of
from disco_twin.experiment.references import reference_path, shipped_references
from disco_twin.light.references import load_reference
from disco_twin.report.figures import tone
from disco_twin.scene.scene import load_scene
from hw.base.arrays import F64

LIGHTS = ("environment", "directional")  # the rows
QUALITY = 85


def strip(scene_file: Path, folder: Path) -> F64:
    """(H * lights, W, 3) display values of one object from the first held-out view, all light that leaves it."""
    scene = load_scene(scene_file)
    view, lights = scene.relight.views[0], {light.name: light for light in scene.relight.lights}
    rows = []
    for name in LIGHTS:
        image = load_reference(reference_path(folder, lights[name], view)).halves.mean(axis=0).sum(axis=0)
        rows.append(tone(image, float(np.percentile(image, 99)), len(image)))
    return np.concatenate(rows)


def main(target: Path) -> None:
    """Draw the objects side by side, those to choose on first."""
    strips = [strip(path, shipped_references(path, path.stem)) for name in ("choose", "score") for path in set_of(name)]
    middle = [s[:, s.shape[1] // 6 : -(s.shape[1] // 6)] for s in strips]  # objects stand in the middle
    picture = Image.fromarray(np.rint(255 * np.concatenate(middle, axis=1)).astype(np.uint8))
    picture.save(target, quality=QUALITY)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
