"""A scene of one sphere."""

from __future__ import annotations

from disco_twin.experiment.experiment import Experiment
from disco_twin.scene.scene import Scene


def sphere(aim: tuple[float, float, float] = (0.0, 0.0, 0.0), **rig_changes: object) -> Experiment:
    camera = {"position_mm": [450.0, 0.0, 50.0], "width": 32, "height": 32}
    return Experiment(
        Scene.model_validate(
            {
                "format_version": 1,
                "name": "sphere",
                "object": {
                    "shape": {"kind": "sphere"},
                    "medium": {"base": {"kind": "homogeneous", "sigma_t_per_mm": 1.0, "albedo": 0.9}},
                },
                "scan": {"vertices": 162},
                "rig": {"cameras": [camera | {"name": "a"}], "spots": 20, **rig_changes},
                "relight": {"views": [camera | {"name": "b"}, camera | {"name": "c", "aim_mm": aim}]},
            }
        )
    )
