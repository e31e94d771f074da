"""Whether a capture's own images contradict its stated poses: silhouettes first, then the places of the spots."""

from __future__ import annotations

import logging
from pathlib import Path

from hw.base.config import read_json
from pipeline.capture.loop import Progress
from pipeline.capture.silhouettes import SLACK, examine_silhouettes, silhouettes_of
from pipeline.capture.spot_places import examine_spots, sightings_of
from pipeline.geometry.mesh_file import read_scan
from pipeline.plan.plan import ImageAddress, Plan
from pipeline.plan.targets import FOLDER
from pipeline.records import NominalRigFile, SensorFile
from pipeline.stream.files import PLAN
from pipeline.stream.stream import StreamReader

log = logging.getLogger(__name__)


def watching(capture: Path, plan: Plan, progress: Progress) -> Progress:
    """A report of progress that looks at every silhouette as it is stored, and warns of the first that does not fit.

    A capture takes hours; that a camera's driver mirrors its images is to be known after the first view.
    """
    silhouettes = {plan.index(ImageAddress(view, "silhouette")) + 1 for view in range(plan.views)}
    told: list[str] = []

    def report(done: int, total: int) -> None:
        progress(done, total)
        if done in silhouettes and not told:
            told.extend(pose_warnings(capture, spots=False))
            for line in told:
                log.warning("%s", line)

    return report


def pose_warnings(capture: Path, spots: bool = True) -> list[str]:
    """What a capture's images, as many as are stored, say against its nominal rig and scan, one line each.

    spots: whether their places are looked at, too. Where images of targets are there to calibrate the poses from, the
    object may lie a little beside its place. None of a folder without the records that images are compared with (its
    readers refuse it anyway). Raises: InputError where these cannot be read.
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
        if not (spots and silhouettes.fits):  # where they do not fit, spots cannot
            return silhouettes.warnings()
        return examine_spots(list(sightings_of(stream, sensor)), rig, mesh, slack).warnings()
