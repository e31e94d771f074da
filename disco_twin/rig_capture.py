"""`disco-twin capture SCENE --rig rig.toml`: the capture by the devices of a rig file; the swap is this one word.

The folder keeps the rig file, and knows by it that devices took its images: nothing simulates or removes them later.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from disco_twin.assembly import assembled
from disco_twin.folder import content_key, write_atomically
from disco_twin.rig_file import EMULATED, DevicesFile, load_rig_file, require_scene
from hw.errors import InputError
from hw.record import Sensor
from pipeline.capture.files import IMAGES
from pipeline.capture.loop import capture

if TYPE_CHECKING:
    from disco_twin.console import Report
    from disco_twin.rig import TwinRig
    from disco_twin.run import Run

log = logging.getLogger(__name__)


def open_rig_file(run: Run, path: Path, armed: bool) -> DevicesFile:
    """Read a rig file for a run; real lasers need to be armed explicitly."""
    file = load_rig_file(path)
    require_scene(file, run.scene.rig, path)
    if file.real_lasers and not armed:
        ports = ", ".join(laser.port for laser in file.lasers if laser.port != EMULATED)
        raise InputError(
            f"real lasers will emit ({ports})",
            file=path,
            remedy="see to interlock, door and goggles, then repeat the command with --arm",
        )
    if (run.folder.capture / IMAGES).exists() and not run.folder.taken_by_devices:
        raise InputError("this folder holds a simulated capture", file=run.folder.root, remedy="choose another --out")
    return file


def capture_with_devices(run: Run, file: DevicesFile, path: Path, logs: Path | None) -> None:
    """Scan and capture; continues where it was interrupted, if the rig has not moved since."""
    from disco_twin import simulate

    world, folder = run.world, run.folder
    sensor = None if file.sensor is None or file.simulated_cameras else file.sensor.sensor()
    key = content_key(folder.identity, "devices")
    run.stage("scan", key, lambda _: simulate.write_scan(world, folder.capture, sensor))
    write_atomically(folder.devices_record, path.read_bytes())
    run.stage("capture", key, lambda report: _take_images(run, file, simulate.sensor_of(world, sensor), logs, report),
              "images")  # fmt: skip


def _take_images(run: Run, file: DevicesFile, sensor: Sensor, logs: Path | None, report: Report) -> None:
    with assembled(file, run.scene.rig, _twin(run, file), logs) as rig:
        capture(rig, run.world.plan, run.folder.capture, report, sensor)


def _twin(run: Run, file: DevicesFile) -> TwinRig | None:
    """What simulated cameras look at; emulated devices without one need no light."""
    from disco_twin.rig import TwinRig
    from disco_twin.rig_commands import Darkness

    if file.simulated_cameras:
        from disco_twin.simulate import twin_rig

        return twin_rig(run.world, run.folder)
    if EMULATED in file.ports().values():
        return TwinRig(run.scene.rig, Darkness(), run.scene.seed)
    return None
