"""A whole emulated rig: devices on a bench, each on a line of its own, reached through the real drivers."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

from disco_twin.emulation.bench import Bench, MirroredDevices
from disco_twin.emulation.rig_file_of import emulated_rig_file
from disco_twin.emulation.twin_rig import TwinRig
from disco_twin.firmware.mm_ard import MmArdFirmware
from disco_twin.firmware.omicron import OmicronFirmware
from disco_twin.firmware.wire import Cable
from disco_twin.firmware.zaber import ZaberFirmware
from hw.base.clock import Clock, VirtualClock, WallClock
from hw.rig.connect import Connector, StandIns
from hw.rig.rig_file import DevicesFile
from hw.rig.serial_rig import SerialRig, open_rig
from hw.serial.ports.protocol_memory import attach
from pipeline.geometry.nominal_rig import RigConfig

_NUMBERS = itertools.count()


class Emulation:
    """The devices of a twin as firmware on lines. `cables` by name: laser0 .., board, turntable."""

    def __init__(self, twin: TwinRig, clock: Clock | None = None) -> None:
        self.clock: Clock = VirtualClock() if clock is None else clock
        self.bench = Bench(twin, self.clock)
        self.cables: dict[str, Cable] = {}
        for i, head in enumerate(self.bench.heads):
            self.cables[f"laser{i}"] = cable = Cable(OmicronFirmware(head), self.clock)
            cable.on_closed = partial(self.bench.left, i)
        self.cables["board"] = Cable(MmArdFirmware(self.bench.board), self.clock)
        self.cables["turntable"] = Cable(ZaberFirmware(self.bench.spindle), self.clock)

    def attach(self) -> dict[str, str]:
        """Make every line a memory port; URLs by name."""
        number = next(_NUMBERS)
        return {name: attach(f"emulated-{number}-{name}", line) for name, line in self.cables.items()}

    def stand_ins(self, ports: Mapping[str, str] | None = None, *, cameras: bool = True) -> StandIns:
        """What stands in for devices that are not there.

        ports: URLs of the emulated devices (memory ports if None); cameras: the simulated ones, and with them the
        record's clock, which goes by their frames
        """
        ports = self.attach() if ports is None else ports
        if not cameras:
            return StandIns(self.clock, ports)
        bench, twin = self.bench, self.bench.twin
        return StandIns(self.clock, ports, bench.cameras, twin, twin.announce, MirroredDevices(bench))

    def serial_rig(self, logs: Path | None = None, urls: Mapping[str, str] | None = None) -> SerialRig:
        """The rig with everything emulated, reached through `urls`. logs: a folder for the byte logs."""
        connector = Connector(emulated_rig_file(self.bench.twin.config), self.stand_ins(urls), logs)
        return SerialRig(connector, self.bench.cameras, armed=True)


def open_scene_rig(
    file: DevicesFile, scene: RigConfig, twin: TwinRig | None = None, logs: Path | None = None, *, armed: bool
) -> AbstractContextManager[SerialRig]:
    """The rig of a scene's rig file, whatever of it is real. `twin`: where something is emulated or simulated.

    armed: real lasers may emit. Emulated ones need no permission.
    """
    clock: Clock = VirtualClock() if file.all_emulated and file.simulated_cameras else WallClock()
    stand_ins = None if twin is None else Emulation(twin, clock).stand_ins(cameras=file.simulated_cameras)
    shapes = {camera.name: (camera.height, camera.width) for camera in scene.cameras}
    return open_rig(file, shapes, stand_ins, logs, armed=armed)
