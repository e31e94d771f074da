"""Whether a capture's own images contradict its stated poses: silhouettes first, then the places of the spots."""

from __future__ import annotations

from pathlib import Path

from hw.base.config import read_json
from pipeline.capture.silhouettes import SLACK, examine_silhouettes, silhouettes_of
from pipeline.capture.spot_places import examine_spots, sightings_of
from pipeline.geometry.mesh_file import read_scan
from pipeline.plan.targets import FOLDER
from pipeline.records import NominalRigFile, SensorFile
from pipeline.stream.files import PLAN
from pipeline.stream.stream import StreamReader


def pose_warnings(capture: Path) -> list[str]:
    """What a capture's images, as many as are stored, say against its nominal rig and scan, one line each.

    Where images of targets are there to calibrate the poses from, the object may lie a little beside its place.

    None of a folder without the records that images are compared with (its readers refuse it anyway).
    Raises: InputError where these cannot be read.
    """
    if not all((capture / name).is_file() for name in ("rig.json", "sensor.json", "scan.ply", PLAN)):
        return []
    again = "repeat the capture command"
    rig = read_json(capture / "rig.json", NominalRigFile, again).rig
    sensor = read_json(capture / "sensor.json", SensorFile, again).sensor
    mesh = read_scan(capture / "scan.ply", again)
    slack = SLACK if (capture / FOLDER).is_dir() else 0.0
    with StreamReader(capture) as stream:
        silhouettes = examine_silhouettes(silhouettes_of(stream), sensor, rig, mesh, slack=slack)
        if not silhouettes.fits:  # where they do not, spots cannot
            return silhouettes.warnings()
        return examine_spots(list(sightings_of(stream, sensor)), rig, mesh, slack).warnings()
