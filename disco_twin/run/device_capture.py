"""`disco-twin capture SCENE --rig rig.toml`: the capture by the devices of a rig file; the swap is this one word.

The folder keeps the rig file, which marks its images as taken by devices: nothing simulates or removes them later,
and no other rig continues them.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.emulation.emulated_rig import open_scene_rig
from disco_twin.emulation.served_rig import Darkness
from disco_twin.emulation.twin_rig import TwinRig
from disco_twin.experiment.keys import content_key
from disco_twin.run import simulate
from disco_twin.run.scan import write_scan
from hw.base.errors import InputError, naming
from hw.base.files import require_folder, write_atomically
from hw.rig.rig_file import EMULATED, DevicesFile
from hw.rig.rig_rules import load_rig_file
from pipeline.capture.loop import capture
from pipeline.capture.poses import pose_warnings, watching
from pipeline.capture.rig_fits_scene import require_reach, require_same, require_scene
from pipeline.stream.files import IMAGES
from pipeline.stream.stream import StreamReader

if TYPE_CHECKING:
    from disco_twin.run.progress import Report
    from disco_twin.run.stages import Run

log = logging.getLogger(__name__)


def open_rig_file(run: Run, path: Path, armed: bool) -> DevicesFile:
    """Read a rig file for a run; real lasers need to be armed explicitly. Raises: InputError."""
    file = load_rig_file(path)
    require_scene(file, run.scene.rig, path)
    if file.real_lasers and not armed:
        ports = ", ".join(laser.port for laser in file.lasers if laser.port != EMULATED)
        remedy = "see to interlock, door and goggles, then repeat the command with --arm"
        raise InputError(f"real lasers will emit ({ports})", file=path, remedy=remedy)
    require_reach(file, run.experiment.plan, path)
    folder = run.folder
    if (folder.capture / IMAGES).exists() and not folder.taken_by_devices:
        raise InputError("this folder holds a simulated capture", file=folder.root, remedy="choose another --out")
    if _has_images(folder.capture):
        require_same(file, _begun_with(folder.devices_record), path)
    return file


def _begun_with(record: Path) -> DevicesFile:
    """The rig file that a capture keeps."""
    try:
        return load_rig_file(record)
    except InputError as error:
        problem = f"the capture's own copy of its rig file cannot be used ({error.problem})"
        remedy = "put the rig file there that the capture was begun with, or choose another --out"
        raise error.amended(problem=problem, file=record, remedy=remedy) from error


def _has_images(folder: Path) -> bool:
    """Before the first image the rig file may still be corrected."""
    if not (folder / IMAGES).exists():
        return False
    with StreamReader(folder) as stored:
        return len(stored) > 0


def capture_with_devices(run: Run, path: Path, logs: Path | None, *, armed: bool) -> None:
    """Scan and capture; continues where it was interrupted, if the rig is the same and has not moved since.

    Raises: InputError for a rig file, a folder or a scan that does not serve; what the devices raise.
    """
    file, experiment, folder = open_rig_file(run, path, armed), run.experiment, run.folder
    for warning in experiment.warnings:
        log.warning("%s", warning)
    if logs is not None:
        require_folder(logs, "--logs")
    if not _has_images(folder.capture):  # what the images are begun with is kept
        write_atomically(folder.devices_record, path.read_bytes())
    real = None if file.simulated_cameras else file.sensor
    sensor = lars3_sensor(run.scene.rig) if real is None else real.sensor()
    key = content_key(folder.identity.encode(), b"devices")  # bytes: the key that earlier versions gave it
    scan_key = content_key(key.encode(), repr(sensor).encode())  # the sensor may be corrected before the first image
    run.stage("scan", scan_key, lambda _: write_scan(experiment, folder.capture, sensor))

    def take_images(report: Report) -> None:
        with naming(path), open_scene_rig(file, run.scene.rig, _twin(run, file), logs, armed=armed) as rig:
            watched = watching(folder.capture, experiment.plan, report)
            capture(rig, experiment.plan, folder.capture, watched, sensor)

    run.stage("capture", key, take_images, "images")
    for warning in pose_warnings(folder.capture):
        log.warning("%s", warning)


def _twin(run: Run, file: DevicesFile) -> TwinRig | None:
    """What simulated cameras look at; emulated devices without one need no light."""
    if file.simulated_cameras:
        return simulate.twin_rig(run.experiment, run.folder.twin / "responses")
    if EMULATED in file.ports().values():
        return TwinRig(run.scene.rig, Darkness(), run.scene.seed)
    return None
