"""The stage `scan`: what the pipeline is given beside images and their plan."""

from __future__ import annotations

from pathlib import Path

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.experiment.capturable import require_capturable
from disco_twin.experiment.experiment import Experiment
from hw.base.files import write_atomically
from hw.record import Sensor
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
