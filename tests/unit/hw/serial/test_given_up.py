"""A question that was given up, its last answer still on the way: it must not answer the next, on any device."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from serial_fakes import BoardBench, Bus, ElliptecBench, LaserBench, MeterBench, TableBench

from disco_twin.firmware.mm_ard import MirrorHead
from disco_twin.firmware.wire import late, lost
from hw.base.errors import NoAnswer
from hw.serial.link import Link

DELAYS = (0.25, 0.55, 1.05, 1.3)  # beyond the drivers' time limits of 0.2, 0.5 and 1 s, and of one silence


def gave_up(ask: Callable[[], object]) -> bool:
    try:
        ask()
    except NoAnswer:
        return True
    return False


def give_up(bus: Bus, ask: Callable[[], object], delay: float, losses: int) -> None:
    """Lose answers until the driver gives up; the last ones come late."""
    bus.line.answer_faults.extend([*[lost] * losses, *[late(delay)] * 8])
    any(gave_up(ask) for _ in range(5))
    bus.line.answer_faults.clear()


@pytest.mark.parametrize("losses", range(7))
@pytest.mark.parametrize("delay", DELAYS)
def test_laser(delay: float, losses: int) -> None:
    bench = LaserBench()
    laser = bench.connect()
    laser.arm(40.0)
    laser.emit()
    give_up(bench, laser.measured_mw, delay, losses)
    bench.head.level = 0.7
    assert laser.measured_mw() == pytest.approx(70.0)


@pytest.mark.parametrize("losses", range(7))
@pytest.mark.parametrize("delay", DELAYS)
def test_board(delay: float, losses: int) -> None:
    value = [100]
    bench = BoardBench(head=MirrorHead(sample=lambda pin: value[0]))
    board = bench.connect()
    give_up(bench, lambda: board.counts(0), delay, losses)
    value[0] = 900
    assert board.counts(0) == 900
    give_up(bench, board.lines, delay, losses)
    bench.head.set_pattern(0b101)
    assert board.lines() == 0b101
    board.set_lines(0b11)
    give_up(bench, lambda: board.counts(0), delay, losses)
    before, seen = bench.now(), []
    write = board.link.write

    def watch(link: Link, data: bytes) -> None:
        write(data)
        seen.append((bench.now() - before, bench.head.lines))

    board.link.write = watch.__get__(board.link)  # type: ignore[method-assign]
    board.shut()
    assert seen[0] == (0.0, 0)  # dark at once, in step later


@pytest.mark.parametrize("losses", range(7))
@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("make", [TableBench, ElliptecBench])
def test_turntables(make: type[TableBench] | type[ElliptecBench], delay: float, losses: int) -> None:
    bench = make()
    table = bench.connect()
    table.home()
    give_up(bench, table.angle_rad, delay, losses)
    bench.spindle.go(90.0, bench.now() - 100.0)
    assert table.angle_rad() == pytest.approx(math.pi / 2, abs=1e-4)


@pytest.mark.parametrize("losses", range(7))
@pytest.mark.parametrize("delay", DELAYS)
def test_meter(delay: float, losses: int) -> None:
    bench = MeterBench(watts=1e-3)
    meter = bench.connect()
    give_up(bench, meter.read, delay, losses)
    bench.watts = 5e-3
    assert meter.read() == pytest.approx(5e-3)
