"""The JSON files that hand something on between the twin and the pipeline, as schemas; all carry `format_version`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, model_validator

from hw.base.config import Strict, as_table
from hw.base.files import write_atomically
from hw.record import Sensor
from pipeline.geometry.nominal_rig import RigConfig


class NominalRigFile(Strict):
    """CAPTURE/rig.json: the nominal rig."""

    format_version: Literal[1]
    rig: RigConfig

    @model_validator(mode="before")
    @classmethod
    def _without_faults(cls, data: Any) -> Any:
        """Captures of before held a table `faults` in the rig, which was of no use to the pipeline."""
        rig = data.get("rig") if isinstance(data, dict) else None
        return data | {"rig": {k: v for k, v in rig.items() if k != "faults"}} if isinstance(rig, dict) else data


class SensorFile(Strict):
    """CAPTURE/sensor.json: what is known of the cameras' sensor."""

    format_version: Literal[1]
    sensor: Annotated[Sensor, as_table(Sensor)]


def write_capture_records(capture: Path, scan_ply: bytes, rig: RigConfig, sensor: Sensor) -> None:
    """CAPTURE/scan.ply, rig.json, sensor.json: what the pipeline is given beside the images and their plan."""
    write_atomically(capture / "scan.ply", scan_ply)
    for name, record in (
        ("rig.json", NominalRigFile(format_version=1, rig=rig)),
        ("sensor.json", SensorFile(format_version=1, sensor=sensor)),
    ):
        write_atomically(capture / name, record.model_dump_json(indent=1).encode())


class Figures(Strict):
    """A record that may hold more than its readers need."""

    model_config = ConfigDict(extra="ignore")


class StageFigures(Figures):
    """What a stage of the pipeline took."""

    name: str
    seconds: float
    peak_mb: float


class MethodFigures(Figures):
    """What a method took, and how its model came about."""

    seconds: float
    provenance: dict[str, str]


class PipelineRecord(Figures):
    """WORK/pipeline.json: what the pipeline did, in the order of the work; `methods` by name."""

    format_version: Literal[1]
    stages: tuple[StageFigures, ...]
    methods: dict[str, MethodFigures]
    capture: dict[str, Any]
    calibration: dict[str, Any] = Field(default_factory=dict)  # `source`, and what its measurement found
    left_out: tuple[dict[str, str], ...]
    warnings: tuple[str, ...]
