"""`python -m benchmarks.accuracy_picture FILE.jpg`: the shapes of docs/accuracy.md, as the held-out views see them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.accuracy import set_of
from disco_twin.experiment.experiment import Experiment
from disco_twin.scene.scene import load_scene
from hw.base.arrays import F64
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.mesh import RayMesh

SUPERSAMPLE = 3
SKY, AHEAD = 0.4, 0.6  # shares of light from above and of light from the camera
GAMMA, QUALITY = 1.2, 88


def shaded(scene_file: Path) -> F64:
    """(H * views, W) display values of one object, a view below the other; opaque, so that folds and edges show."""
    experiment, views = Experiment(load_scene(scene_file)), []
    mesh = experiment.object.mesh
    for view in experiment.scene.relight.views:
        camera = PinholeCamera.from_config(view)
        origins, directions = camera.rays(camera.pixel_centres(SUPERSAMPLE))
        face = RayMesh.of(mesh).first_hit(origins, directions).triangle
        normal = np.asarray(mesh.face_normals)[face]
        light = AHEAD * np.clip(-(normal * directions).sum(axis=1), 0, 1) + SKY * (0.5 + 0.5 * normal[:, 2])
        fine = np.where(face >= 0, light, 0.0).reshape(camera.height, SUPERSAMPLE, camera.width, SUPERSAMPLE)
        views.append(fine.mean(axis=(1, 3)) ** (1 / GAMMA))
    return np.concatenate(views)


def main(target: Path) -> None:
    """Draw the objects side by side, those to choose on first."""
    strips = [shaded(path) for name in ("choose", "score") for path in set_of(name)]
    picture = Image.fromarray(np.rint(255 * np.clip(np.concatenate(strips, axis=1), 0, 1)).astype(np.uint8))
    picture.save(target, quality=QUALITY)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
