"""Emulated devices on memory ports with a virtual clock, for the tests of drivers and rig."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from disco_twin.firmware.elliptec import ElliptecFirmware
from disco_twin.firmware.mm_ard import MirrorHead, MmArdFirmware
from disco_twin.firmware.omicron import LaserHead, OmicronFirmware
from disco_twin.firmware.ophir import OphirFirmware
from disco_twin.firmware.turning import Spindle
from disco_twin.firmware.wire import Cable, Firmware
from disco_twin.firmware.zaber import MICROSTEPS_PER_DEG, ZaberFirmware
from hw.base.clock import VirtualClock
from hw.devices.elliptec import ElliptecTable
from hw.devices.mm_ard import MirrorBoard
from hw.devices.omicron import OmicronLaser
from hw.devices.ophir import OphirMeter
from hw.devices.zaber import ZaberTable
from hw.serial.bytelog import ByteLog
from hw.serial.link import Link
from hw.serial.ports.protocol_memory import attach


@dataclass
class Bus:
    """One emulated device on `memory://name`, and links to it."""

    firmware: Firmware
    name: str = "device"
    clock: VirtualClock = field(default_factory=VirtualClock)
    log: Path | None = None

    def __post_init__(self) -> None:
        self.line = Cable(self.firmware, self.clock)
        self.url = attach(self.name, self.line)

    def link(self, device: str) -> Link:
        return Link(self.url, self.firmware.baud, device, self.clock, ByteLog(self.log) if self.log else None)

    def now(self) -> float:
        return self.clock.now()


@dataclass
class LaserBench(Bus):
    firmware: Firmware = None  # type: ignore[assignment]
    head: LaserHead = field(default_factory=lambda: LaserHead(532.0, 100.0))

    def __post_init__(self) -> None:
        self.firmware = OmicronFirmware(self.head)
        super().__post_init__()

    def connect(self) -> OmicronLaser:
        return OmicronLaser(self.link("laser 532 nm"), 532.0)


@dataclass
class BoardBench(Bus):
    firmware: Firmware = None  # type: ignore[assignment]
    head: MirrorHead = field(default_factory=MirrorHead)

    def __post_init__(self) -> None:
        self.firmware = MmArdFirmware(self.head)
        super().__post_init__()

    def connect(self) -> MirrorBoard:
        return MirrorBoard(self.link("mirror board"))


@dataclass
class TableBench(Bus):
    firmware: Firmware = None  # type: ignore[assignment]
    spindle: Spindle = field(default_factory=lambda: Spindle(angle_deg=30.0))

    def __post_init__(self) -> None:
        self.firmware = ZaberFirmware(self.spindle)
        super().__post_init__()

    def connect(self, reach_s: float = 20.0) -> ZaberTable:
        return ZaberTable(self.link("turntable"), MICROSTEPS_PER_DEG, reach_s)


@dataclass
class ElliptecBench(Bus):
    firmware: Firmware = None  # type: ignore[assignment]
    spindle: Spindle = field(default_factory=lambda: Spindle(angle_deg=30.0))

    def __post_init__(self) -> None:
        self.firmware = ElliptecFirmware(self.spindle)
        super().__post_init__()

    def connect(self, reach_s: float = 20.0) -> ElliptecTable:
        return ElliptecTable(self.link("turntable"), reach_s=reach_s)


@dataclass
class MeterBench(Bus):
    firmware: Firmware = None  # type: ignore[assignment]
    watts: float = 1.23e-3

    def __post_init__(self) -> None:
        self.firmware = OphirFirmware(lambda: self.watts)
        super().__post_init__()

    def connect(self) -> OphirMeter:
        return OphirMeter(self.link("power meter"))


class ScaledClock:
    """Real time, five times faster, for devices behind terminals and sockets.

    It stands still while nobody looks: a busy machine that leaves this process waiting runs into no time limit.
    """

    FACTOR = 5.0
    STEP_S = 0.02  # it goes on by this much at most between two looks

    def __init__(self) -> None:
        self._lock, self._now, self._seen = threading.Lock(), 0.0, time.monotonic()

    def now(self) -> float:
        with self._lock:
            real = time.monotonic()
            self._now += min((real - self._seen) * self.FACTOR, self.STEP_S)
            self._seen = real
            return self._now

    def sleep(self, seconds: float) -> None:
        end = self.now() + seconds
        while (left := end - self.now()) > 0.0:
            time.sleep(min(left, self.STEP_S) / self.FACTOR)


class PatientClock(ScaledClock):
    """Real time, but nobody waits for what takes its time (`sleep`)."""

    FACTOR = 1.0

    def sleep(self, seconds: float) -> None:
        """Move on at once."""
        with self._lock:
            self._now += max(0.0, seconds)
