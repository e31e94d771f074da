"""What a line does to answers, and how long everything takes: the figures of the devices' manuals and sources."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from serial_fakes import BoardBench, LaserBench

from disco_twin.firmware.mm_ard import Galvo
from disco_twin.firmware.omicron import LaserHead, OmicronFirmware
from disco_twin.firmware.turning import Spindle
from disco_twin.firmware.wire import Cable, Timed, late, lost, split
from hw.base.clock import VirtualClock


class Echo:
    """Answers every byte after a delay."""

    baud = 9600

    def __init__(self, delays: list[float]) -> None:
        self.delays = delays

    def opened(self, now: float) -> None:
        pass

    def power_cycle(self, now: float) -> None:
        pass

    def feed(self, data: bytes, now: float) -> list[Timed]:
        return [(self.delays[i % len(self.delays)], bytes([byte])) for i, byte in enumerate(data)]


def read_all(line: Cable, clock: VirtualClock) -> list[tuple[float, bytes]]:
    got = []
    while data := line.deliver(100, 10.0):
        got.append((clock.now(), data))
    return got


def test_baud_rate_and_latency_of_a_laser() -> None:
    """?GFw CR is 5 bytes, the answer 16: at 57600 baud, 8N1, with 15 ms in between."""
    clock = VirtualClock()
    line = Cable(OmicronFirmware(LaserHead(532.0, 100.0), baud=57_600), clock)
    line.opened()
    line.receive(b"?GFw\r")
    ((time, data),) = read_all(line, clock)[:1]
    assert data == b"!GFwLuxX\xa74\xa71.90\r"
    assert time == pytest.approx((5 + len(data)) * 10 / 57_600 + 0.015)


def test_times_of_the_devices() -> None:
    head = LaserHead(532.0, 100.0, stored_level=0xFFF)
    head.switch_on(0.0)
    assert [head.emission(t) for t in (0.0, 2.99, 3.0)] == [0.0, 0.0, 1.0]
    firmware = OmicronFirmware(head)
    assert [t for t, _ in firmware.feed(b"?RsC\r", 10.0)] == [0.015, 5.0]
    assert firmware.feed(b"?GFw\r", 14.9) == []
    assert len(firmware.feed(b"?GFw\r", 15.1)) == 1
    board = BoardBench()
    board.line.opened()
    assert board.firmware.feed(b"\x1e", 1.9) == []
    assert len(board.firmware.feed(b"\x1e", 2.1)) == 1
    galvo = Galvo(start=0, target=0)
    galvo.aim(4095, 0.0)
    assert 0 < galvo.position(0.002) < 4095
    assert galvo.position(0.005) == 4095
    spindle = Spindle()
    assert spindle.go(180.0, 0.0) < 8.0
    assert spindle.busy(4.0)
    assert not spindle.busy(4.4)


@given(st.lists(st.sampled_from([None, late(0.5), late(2.0), split(0), split(1)]), max_size=8), st.binary(min_size=8))
def test_whatever_is_late_the_order_is_kept(faults: list[object], data: bytes) -> None:
    clock = VirtualClock()
    line = Cable(Echo([0.01]), clock)
    line.opened()
    line.answer_faults.extend(faults)  # type: ignore[arg-type]
    line.receive(data)
    got = read_all(line, clock)
    assert b"".join(d for _, d in got) == data


def test_an_answer_that_takes_long_does_not_hold_up_the_next_one() -> None:
    clock = VirtualClock()
    line = Cable(Echo([3.0, 0.1]), clock)
    line.opened()
    line.receive(b"ab")
    assert [d for _, d in read_all(line, clock)] == [b"b", b"a"]


def test_lost_answers_have_taken_effect_lost_commands_have_not() -> None:
    bench = LaserBench()
    link = bench.link("laser")
    bench.line.answer_faults.append(lost)
    bench.line.receive(b"?SLP800\r")
    assert bench.head.stored_level == 0x800
    bench.line.command_faults.append(lambda _: b"")
    bench.line.receive(b"?SLP000\r")
    assert bench.head.stored_level == 0x800
    link.close()
