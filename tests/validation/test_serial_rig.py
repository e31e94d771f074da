"""The shipped scene, captured through drivers, protocols and emulated firmware."""

from __future__ import annotations

from pathlib import Path

import pytest
from replay import read_log

from disco_twin.emulation.emulated_rig import Emulation
from disco_twin.emulation.twin_rig import TwinRig
from disco_twin.evaluate.simulation_noise import spot_cost
from disco_twin.experiment.experiment import Experiment
from disco_twin.faults.actual_rig import actual_rig
from disco_twin.scene.scene import load_scene
from pipeline.capture.loop import capture
from pipeline.stream.files import IMAGES, JOURNAL, PLAN

pytestmark = pytest.mark.slow


def test_quick_through_serial_lines_equals_the_direct_twin(repository: Path, tmp_path: Path) -> None:
    """Rationale: between the capture loop and the twin lie five protocols; none may change an image or its record.

    Expected behaviour: 1806 images, and the three files of the stream are the same bytes; no light while anything
    moves, never two lasers at once.
    """
    experiment = Experiment(load_scene(repository / "scenes" / "quick.toml", faults=False))
    scene, transport = experiment.scene, experiment.transport
    from disco_twin.light.response import SpotResponses

    actual = actual_rig(scene.rig, scene.seed)

    def twin() -> TwinRig:
        walks, light = spot_cost(experiment).walks, tmp_path / "light"
        responses = SpotResponses(transport, scene.rig, actual, walks, experiment.seed("spots"), light)
        return TwinRig(scene.rig, responses, scene.seed, actual)

    direct, serial = tmp_path / "direct", tmp_path / "serial"
    assert capture(twin(), experiment.plan, direct) == 0 and len(experiment.plan) == 1806
    emulated = Emulation(twin())
    capture(emulated.serial_rig(tmp_path / "logs"), experiment.plan, serial)
    for name in (IMAGES, JOURNAL, PLAN):
        assert (serial / name).read_bytes() == (direct / name).read_bytes(), name
    assert emulated.bench.hazards == []
    sent = [event for event in read_log(tmp_path / "logs" / "board.log") if event.mark == ">"]
    assert len(sent) > 13_000  # it did go through the line
