"""The MM-Ard driver and the emulated board: DAC, TTL lines, converter, the traps of a protocol without frames."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from serial_fakes import BoardBench, LaserBench, TableBench

from disco_twin.firmware.mm_ard import MirrorHead, MmArdFirmware
from disco_twin.firmware.wire import Fault, after, garbled, late, lost, split
from hw.base.errors import DeviceRefused, Garbled, InputError, NoAnswer, Unplugged, WrongDevice
from hw.devices.mm_ard import ADC_TOP, BOOT_S, FORGET_S, MirrorBoard


def positions(bench: BoardBench) -> tuple[float, ...]:
    bench.clock.sleep(0.01)
    return tuple(galvo.position(bench.now()) for galvo in bench.head.galvos)


# ---- identity


def test_connecting_waits_for_the_board_and_shuts_its_lines() -> None:
    bench = BoardBench()
    bench.head.set_pattern(0b111)
    bench.head.blanking = True
    board = bench.connect()
    assert board.version == 5
    assert BOOT_S <= bench.now() < BOOT_S + 0.2
    assert bench.head.lines == 0
    assert not bench.head.blanking


def test_a_board_that_opening_does_not_reset_is_shut_and_leaves_its_blanking_mode() -> None:
    """A terminal does not reset it; in blanking mode lines follow a trigger input that nothing is plugged into."""
    bench = BoardBench()
    bench.line.firmware.opened = lambda now: None  # type: ignore[method-assign]
    bench.head.set_pattern(0b111)
    board = bench.connect()
    assert bench.head.lines == 0
    bench.head.blanking = bench.head.blank_on_high = True
    board = bench.connect()
    board.set_lines(0b10)
    assert not bench.head.blanking and bench.head.lines == 0b10


@pytest.mark.parametrize("make", [LaserBench, TableBench])
def test_another_device_on_the_port_is_refused(make: Callable[[], LaserBench | TableBench]) -> None:
    with pytest.raises(WrongDevice, match=r"mirror board is not an MM-Ard board.*Remedy.*rig probe"):
        MirrorBoard(make().link("mirror board"))


@pytest.mark.parametrize("channels", [0, 1])
def test_a_board_without_a_dac_is_refused(channels: int) -> None:
    """Its command 3 echoes and does nothing."""
    bench = BoardBench(head=MirrorHead(channels=channels))
    assert MmArdFirmware(bench.head).feed(b"\x03\x00\x0f\xff", 10.0)[0][1] == b"\x03\x00\x0f\xff"
    assert bench.head.galvos[0].target == 2048
    with pytest.raises(WrongDevice, match=f"built for {channels} DAC channels.*TLV5618"):
        bench.connect()


# ---- what it does


@given(st.integers(0, 4095), st.integers(0, 4095))
def test_dac_values_reach_the_mirrors(u: int, v: int) -> None:
    bench = BoardBench()
    bench.connect().set_mirrors(u, v)
    assert positions(bench) == (u, v)


def test_lines_and_converter() -> None:
    bench = BoardBench(head=MirrorHead(sample=lambda pin: 1023 - pin))
    board = bench.connect()
    for pattern in (0b1, 0b100000, 0b101, 0, 0b111111):
        board.set_lines(pattern)
        assert bench.head.lines == board.lines() == pattern
    assert [board.counts(pin) for pin in range(6)] == [1023, 1022, 1021, 1020, 1019, 1018]


def test_a_reading_beyond_the_converters_range_is_its_top() -> None:
    bench = BoardBench(head=MirrorHead(sample=lambda pin: 0x7FFF))
    assert bench.connect().counts(0) == ADC_TOP


def test_what_does_not_exist_is_refused_before_it_is_sent() -> None:
    board = BoardBench().connect()
    for call in (
        lambda: board.set_mirrors(4096, 0),
        lambda: board.set_mirrors(0, -1),
        lambda: board.set_lines(64),
        lambda: board.counts(6),
    ):
        with pytest.raises(InputError, match="allowed"):
            call()


def test_x_and_y_move_in_turn() -> None:
    """The beam draws an L: this is why the gates are shut in a move."""
    bench = BoardBench()
    seen = []
    bench.head.on_move = lambda: seen.append(tuple(g.target for g in bench.head.galvos))
    bench.connect().set_mirrors(10, 20)
    assert seen == [(2048, 2048), (10, 2048)]
    assert not bench.head.settled(bench.now())
    bench.clock.sleep(0.005)
    assert bench.head.settled(bench.now())


# ---- the line

RECOVERABLE: dict[str, Fault] = {
    "lost": lost,
    "late": late(0.3),
    "very late": late(1.0),
    "split": split(1),
    "split slowly": split(1, 0.15),
    "split too slowly": split(1, 0.5),
    "garbage before": after(b"\x93\xfe"),
    "zeros before": after(b"\0\0"),
    "two in one read": after(b"\x01"),
    "garbled": garbled(0),
    "garbled end": garbled(-1),
}


@pytest.mark.parametrize("name", RECOVERABLE)
@pytest.mark.parametrize("place", range(12))
def test_a_bad_answer_never_moves_anything_elsewhere(name: str, place: int) -> None:
    """One bad answer anywhere in a session: state and readings at its end are those that were asked for."""
    bench = BoardBench(head=MirrorHead(sample=lambda pin: 300 + pin))
    bench.line.answer_faults.extend([None] * place + [RECOVERABLE[name]])
    board = bench.connect()
    board.set_mirrors(30, 4000)
    board.set_lines(0b10)
    assert board.counts(3) == 303
    board.set_mirrors(1, 2)
    assert positions(bench) == (1, 2)
    assert bench.head.lines == 0b10
    board.shut()
    assert bench.head.lines == 0


@pytest.mark.parametrize("keep", range(4))
def test_a_command_that_loses_bytes_is_forgotten_before_the_next_one(keep: int) -> None:
    """The board waits 1 s for what is missing: what is sent meanwhile would be taken for it."""
    bench = BoardBench()
    board = bench.connect()
    bench.line.command_faults.append(lambda data: data[:keep])
    before = bench.now()
    board.set_mirrors(1000, 3000)
    assert positions(bench) == (1000, 3000)
    assert FORGET_S < bench.now() - before < 2.0
    assert bench.head.lines == 0


@given(st.binary(min_size=0, max_size=3).filter(lambda b: not b or b[0] in (1, 3, 22, 41)))
def test_shutting_works_wherever_the_parser_is(unfinished: bytes) -> None:
    """One write shuts every line, in the middle of any command, without waiting for the board to forget it."""
    head = MirrorHead()
    firmware = MmArdFirmware(head)
    head.set_pattern(0b111111)
    firmware.feed(unfinished, 10.0)
    firmware.feed(bytes([0, 0, 0, 1, 0]), 10.1)
    assert head.lines == 0


def test_shut_now_waits_for_nothing() -> None:
    bench = BoardBench()
    board = bench.connect()
    for unfinished in (b"", b"\1", b"\3\0", b"\x29"):
        board.set_lines(0b11)
        board.link.write(unfinished)
        before = bench.now()
        board.darken()
        assert bench.now() == before
        assert bench.head.lines == 0
        board.set_mirrors(3, 4)
        assert positions(bench) == (3, 4)


@pytest.mark.parametrize("unfinished", [b"\1", b"\3", b"\3\0", b"\3\0\7", b"\x29", b"\x16"])
def test_the_first_write_of_a_shut_has_shut(unfinished: bytes) -> None:
    """However long the driver then takes to get back into step."""
    bench = BoardBench()
    board = bench.connect()
    board.set_lines(0b11)
    board.link.write(unfinished)
    seen = []
    bench.line.answer_faults.extend([lambda data: (seen.append(bench.head.lines), [(0.0, data)])[1]] * 9)
    board.shut()
    assert seen[0] == 0
    assert bench.head.lines == 0


def test_leaving_blanking_mode_restores_no_line() -> None:
    """As the published firmware does: PORTB changes with the next pattern only."""
    head = MirrorHead()
    firmware = MmArdFirmware(head)
    lines = []
    for command in (b"\1\7", b"\x14", b"\2", b"\x16\0", b"\x16\1", b"\x15", b"\1\7"):
        firmware.feed(command, 10.0)
        lines.append(head.lines)
    assert lines == [7, 0, 0, 7, 0, 0, 7]


def test_lines_that_do_not_follow_are_noticed() -> None:
    """The echo of command 1 does not hold the pattern; the driver reads it back."""
    bench = BoardBench()
    board = bench.connect()
    bench.line.command_faults.append(lambda data: data[:-1] + b"\x07")
    board.set_lines(0b1)
    assert bench.head.lines == 0b1
    bench.head.set_pattern = lambda pattern: setattr(bench.head, "lines", pattern and 0b111)  # type: ignore[method-assign]
    with pytest.raises(DeviceRefused, match="has its TTL lines at 000111 instead of 000001"):
        board.set_lines(0b1)
    assert bench.head.lines == 0


def test_silence_and_nonsense_end_in_one_line() -> None:
    bench = BoardBench()
    board = bench.connect()
    bench.line.answer_faults.extend([lost] * 10)
    with pytest.raises(NoAnswer, match=r"mirror board did not answer 29 03 29 03 29 03 within 0\.2 s\. Remedy"):
        board.counts(3)
    bench.line.answer_faults.clear()
    bench.line.answer_faults.extend([garbled(0)] * 10)
    with pytest.raises(Garbled, match=r"mirror board answered 29 03 with 3c 03 instead of 29 03|with 3c 03 00 00"):
        board.counts(3)


def test_power_cut_and_unplugging() -> None:
    bench = BoardBench()
    board = bench.connect()
    board.set_lines(0b1)
    bench.line.power_cycle()
    assert bench.head.lines == 0
    board.set_mirrors(5, 6)  # the board starts again within the driver's attempts
    assert positions(bench) == (5, 6)
    bench.line.unplug()
    with pytest.raises(Unplugged, match="mirror board"):
        board.lines()
    bench.line.plug()
    assert bench.connect().lines() == 0


def test_unknown_bytes_get_no_answer() -> None:
    firmware = MmArdFirmware(MirrorHead())
    assert firmware.feed(bytes([0, 4, 13, 10 + 13, 48, 63, 255]), 10.0) == []
    assert firmware.feed(b"\x29\x06", 10.0) == []  # no such pin
