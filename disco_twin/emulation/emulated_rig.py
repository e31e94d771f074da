"""A whole emulated rig: devices on a bench, each on a line of its own, and a `SerialRig` connected to them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from disco_twin.emulation.bench import FLOOD_LINE, LAMP_LINE, Bench
from disco_twin.emulation.twin_rig import TURN_S, TwinRig, watts_per_count
from disco_twin.firmware.mm_ard import MmArdFirmware
from disco_twin.firmware.omicron import OmicronFirmware
from disco_twin.firmware.wire import Line
from disco_twin.firmware.zaber import MICROSTEPS_PER_DEG, ZaberFirmware
from hw.base.clock import Clock, VirtualClock
from hw.devices.mm_ard import MirrorBoard
from hw.devices.omicron import OmicronLaser
from hw.devices.zaber import ZaberTable
from hw.rig.serial_rig import SerialRig
from hw.rig.wiring import Devices, LaserWiring
from hw.serial.bytelog import ByteLog
from hw.serial.link import Link
from hw.serial.ports.protocol_memory import attach

_NUMBERS = itertools.count()


class Emulation:
    """The devices of a twin as firmware on lines. `lines` by name: laser0 .., board, turntable."""

    def __init__(self, twin: TwinRig, clock: Clock | None = None) -> None:
        self.clock: Clock = VirtualClock() if clock is None else clock
        self.bench = Bench(twin, self.clock)
        self.lines = {f"laser{i}": Line(OmicronFirmware(head), self.clock) for i, head in enumerate(self.bench.heads)}
        for i in range(len(self.bench.heads)):
            self.lines[f"laser{i}"].on_closed = partial(self.bench.left, i)
        self.lines["board"] = Line(MmArdFirmware(self.bench.board), self.clock)
        self.lines["turntable"] = Line(ZaberFirmware(self.bench.spindle), self.clock)

    def wiring(self) -> list[LaserWiring]:
        """What is plugged in where."""
        lasers = self.bench.twin.config.lasers
        return [LaserWiring(la.wavelength_nm, la.power_mw, i, i, watts_per_count(la)) for i, la in enumerate(lasers)]

    def attach(self) -> dict[str, str]:
        """Make every line a memory port; URLs by name."""
        number = next(_NUMBERS)
        return {name: attach(f"emulated-{number}-{name}", line) for name, line in self.lines.items()}

    def serial_rig(self, logs: Path | None = None, urls: Mapping[str, str] | None = None) -> SerialRig:
        """The rig, reached through `urls` (memory ports if None). `logs`: a folder for the byte logs."""
        ports = self.attach() if urls is None else urls

        def link(name: str, device: str) -> Link:
            log = None if logs is None else ByteLog(logs / f"{name}.log")
            return Link(ports[name], self.lines[name].firmware.baud, device, self.clock, log)

        def connect() -> Devices:
            with ExitStack() as opened:
                heads = []
                for i, wiring in enumerate(self.wiring()):
                    wavelength = wiring.wavelength_nm
                    port = link(f"laser{i}", f"laser {wavelength:g} nm")
                    opened.callback(port.close)
                    heads.append(OmicronLaser(port, wavelength))
                port = link("board", "mirror board")
                opened.callback(port.close)
                board = MirrorBoard(port)
                port = link("turntable", "turntable")
                opened.callback(port.close)
                table = ZaberTable(port, MICROSTEPS_PER_DEG, reach_s=TURN_S)
                opened.pop_all()
            return Devices(heads, board, table)

        steps = self.bench.twin.config.projector.steps
        return SerialRig(
            connect,
            self.wiring(),
            self.bench.cameras,
            self.clock,
            armed=True,
            flood_line=FLOOD_LINE,
            armed_line=LAMP_LINE,
            timebase=self.bench,
            announce=self.bench.twin.announce,
            centre=(steps // 2, steps // 2),
        )
