"""Every driver on every other device's port: refused in one line that says what was expected and what came."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import pytest
from serial_fakes import BoardBench, Bus, ElliptecBench, LaserBench, MeterBench, TableBench

from disco_twin.firmware.wire import Timed
from disco_twin.firmware.zaber import MICROSTEPS_PER_DEG
from hw.base.errors import WrongDevice
from hw.devices.elliptec import ElliptecTable
from hw.devices.mm_ard import MirrorBoard
from hw.devices.omicron import OmicronLaser
from hw.devices.ophir import OphirMeter
from hw.devices.zaber import ZaberTable
from hw.serial.link import Link


class Parrot:
    """A device of no known kind: greets whatever it is told."""

    baud = 9600

    def opened(self, now: float) -> None:
        pass

    def power_cycle(self, now: float) -> None:
        pass

    def feed(self, data: bytes, now: float) -> list[Timed]:
        return [(0.01, b"HELLO\r\n")]


class ParrotBench(Bus):
    def __init__(self) -> None:
        super().__init__(Parrot())


DRIVERS: dict[type[Bus], tuple[Callable[[Link], object], str]] = {
    LaserBench: (lambda link: OmicronLaser(link, 532.0), "an Omicron laser of 532 nm"),
    BoardBench: (MirrorBoard, "an MM-Ard board"),
    TableBench: (lambda link: ZaberTable(link, MICROSTEPS_PER_DEG), "a Zaber stage"),
    ElliptecBench: (ElliptecTable, "an Elliptec stage"),
    MeterBench: (OphirMeter, "an Ophir meter"),
}


@pytest.mark.parametrize(("own", "found"), [(a, b) for a in DRIVERS for b in (*DRIVERS, ParrotBench) if a is not b])
def test_every_other_device_is_refused(own: type[Bus], found: type[Bus]) -> None:
    connect, expected = DRIVERS[own]
    bench = found()  # type: ignore[call-arg]
    with pytest.raises(WrongDevice) as refused:
        connect(bench.link("the device"))
    text = str(refused.value)
    assert text.startswith(f"{bench.url}: the device is not {expected}")
    assert "rig probe" in text
    assert "\n" not in text
    assert len(text) < 300
    if found is ParrotBench:
        assert "HELLO" in text
    assert bench.now() < 20.0


def test_a_laser_is_not_switched_on_nor_a_gate_opened_by_the_questions_of_other_drivers() -> None:
    """Probing a port must not do anything to what is found there."""
    for connect, _ in DRIVERS.values():
        laser, board, stage = LaserBench(name="laser"), BoardBench(name="board"), TableBench(name="stage")
        laser.head.level = 1.0
        for bench in (laser, board, stage):
            with contextlib.suppress(WrongDevice):
                connect(bench.link("the device"))
        assert laser.head.on_since is None
        assert board.head.lines == 0
        assert [galvo.target for galvo in board.head.galvos] == [2048, 2048]
        assert stage.spindle.angle_deg == 30.0
