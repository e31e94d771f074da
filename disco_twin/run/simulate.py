"""The stage `capture`: the capture by the twin of the rig. Needs the renderer."""

from __future__ import annotations

from pathlib import Path

from disco_twin.emulation.twin_rig import TwinRig
from disco_twin.evaluate.simulation_noise import spot_cost
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.keys import code_key
from disco_twin.faults.actual_rig import actual_rig
from pipeline.capture.loop import Progress, capture

SPOT_CODE = "disco_twin.light.response"


def twin_rig(experiment: Experiment, responses: Path) -> TwinRig:
    """The twin of the rig in front of the object; the simulated light is kept in the folder `responses`."""
    transport = experiment.transport  # starts the renderer, which the next module imports
    from disco_twin.light.response import SpotResponses

    scene = experiment.scene
    actual, walks = actual_rig(scene.rig, scene.seed), spot_cost(experiment).walks
    seed, code = experiment.seed("spots"), code_key(SPOT_CODE)
    light = SpotResponses(transport, scene.rig, actual, walks, seed, responses, code)
    return TwinRig(scene.rig, light, scene.seed, actual)


def take_images(experiment: Experiment, folder: Path, responses: Path, progress: Progress) -> None:
    """The capture into `folder`; continues where it was interrupted."""
    capture(twin_rig(experiment, responses), experiment.plan, folder, progress)
