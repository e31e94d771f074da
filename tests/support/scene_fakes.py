"""A scene of one sphere."""

from __future__ import annotations

from functools import cache

import trimesh

from disco_twin.experiment.experiment import Experiment
from disco_twin.object import shapes
from disco_twin.scene.scene import Scene
from disco_twin.scene.shape_schema import Sphere
from pipeline.geometry.remesh import remesh

VERTICES = 162  # of the scan


def sphere(aim: tuple[float, float, float] = (0.0, 0.0, 0.0), **rig_changes: object) -> Experiment:
    """The rig differs; without a scanner's errors all have one scan, which is made once."""
    camera = {"position_mm": [450.0, 0.0, 50.0], "width": 32, "height": 32}
    scene = Scene.model_validate(
        {
            "format_version": 1,
            "name": "sphere",
            "object": {
                "shape": {"kind": "sphere"},
                "medium": {"base": {"kind": "homogeneous", "sigma_t_per_mm": 1.0, "albedo": 0.9}},
            },
            "scan": {"vertices": VERTICES},
            "rig": {"cameras": [camera | {"name": "a"}], "spots": 20, **rig_changes},
            "relight": {"views": [camera | {"name": "b"}, camera | {"name": "c", "aim_mm": aim}]},
        }
    )
    experiment = Experiment(scene)
    if not scene.rig.faults.scanner:
        experiment.scan = _scan()
    return experiment


@cache
def _scan() -> trimesh.Trimesh:
    return remesh(shapes.sphere(Sphere(kind="sphere")), VERTICES)
