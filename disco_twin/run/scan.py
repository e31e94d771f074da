"""The stage `scan`: what the pipeline is given beside images and their plan."""

from __future__ import annotations

from pathlib import Path

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.experiment.experiment import Experiment
from hw.base.errors import InputError
from hw.base.files import write_atomically
from hw.record import Sensor
from pipeline.calibrate.projector_fit import LEAST_SPOTS
from pipeline.plan.visibility import require_in_sight
from pipeline.records import NominalRigFile, SensorFile


def sensor_of(experiment: Experiment, real: Sensor | None = None) -> Sensor:
    """The sensor as the pipeline is given it: a real camera's, or the twin's."""
    return lars3_sensor(experiment.scene.rig) if real is None else real


def write_scan(experiment: Experiment, capture: Path, sensor: Sensor | None = None) -> None:
    """The nominal rig, its sensor, the scanned mesh. Raises: InputError, see `require_capturable`."""
    require_capturable(experiment)
    rig = NominalRigFile(format_version=1, rig=experiment.scene.rig.nominal())
    known = SensorFile(format_version=1, sensor=sensor_of(experiment, sensor))
    write_atomically(capture / "scan.ply", bytes(experiment.scan.export(file_type="ply")))
    write_atomically(capture / "rig.json", rig.model_dump_json(indent=1).encode())
    write_atomically(capture / "sensor.json", known.model_dump_json(indent=1).encode())


def require_capturable(experiment: Experiment) -> None:
    """Refuse a scene whose devices do not reach the object, or whose capture the pipeline could not use.

    Raises: InputError.
    """
    rig = experiment.scene.rig
    sizes = {(c.width, c.height) for c in rig.cameras}
    if len(sizes) > 1:
        problem, remedy = "the twin's cameras must have one image size", "give all of them one width and height"
        raise InputError(problem, key="rig.cameras", value=sorted(sizes), remedy=remedy)
    for i, view in enumerate(experiment.scene.relight.views):
        require_in_sight(view, experiment.scan, f"relight.views[{i}]", f"the held-out view {view.name!r}")
    experiment.plan  # noqa: B018 - the plan refuses cameras, projector and spots that cannot be
    if rig.faults.deviation and rig.spots < LEAST_SPOTS:
        raise InputError(
            "too few to find the projector from, and the rig is off the nominal one", key="rig.spots", value=rig.spots,
            allowed=f"at least {LEAST_SPOTS} that a camera sees", remedy="more spots, or --no-faults",
        )  # fmt: skip
