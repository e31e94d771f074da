"""Zaber's and Thorlabs's turntables: identity, motion, and what their protocols do on a bad line."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from serial_fakes import BoardBench, ElliptecBench, LaserBench, TableBench

from disco_twin.firmware.elliptec import ElliptecFirmware
from disco_twin.firmware.turning import Spindle
from disco_twin.firmware.wire import Fault, after, garbled, late, lost, split
from disco_twin.firmware.zaber import MICROSTEPS_PER_DEG, ZaberFirmware
from hw.base.errors import DeviceFault, DeviceRefused, NoAnswer, Unplugged, WrongDevice
from hw.devices.elliptec import ElliptecTable
from hw.devices.zaber import ZaberTable, checksum

Bench = TableBench | ElliptecBench
BOTH = pytest.mark.parametrize("make", [TableBench, ElliptecBench])


def degrees(bench: Bench) -> float:
    return bench.spindle.position(bench.now()) % 360.0


@BOTH
def test_it_homes_and_turns(make: Callable[[], Bench]) -> None:
    bench = make()
    table = bench.connect()
    table.home()
    assert degrees(bench) == 0.0
    for angle in (120.0, 240.0, 0.0, 359.9, 33.3, 360.0, -60.0):
        table.move(np.deg2rad(angle))
        assert not bench.spindle.busy(bench.now())
        assert degrees(bench) == pytest.approx(angle % 360.0, abs=0.003)
        assert table.angle_rad() == pytest.approx(np.deg2rad(angle % 360.0), abs=1e-4)


@BOTH
@pytest.mark.parametrize("wrong", [LaserBench, BoardBench])
def test_another_device_on_the_port_is_refused(
    make: Callable[[], Bench], wrong: Callable[[], LaserBench | BoardBench]
) -> None:
    link = wrong().link("turntable")
    with pytest.raises(WrongDevice, match=r"turntable is not an? (Zaber|Elliptec) stage.*Remedy.*rig probe"):
        ZaberTable(link, MICROSTEPS_PER_DEG) if make is TableBench else ElliptecTable(link)


def test_other_stages_are_refused() -> None:
    bench = TableBench()
    with pytest.raises(WrongDevice, match=r"has 768000 microsteps a turn instead of 360000 \(microsteps_per_deg\)"):
        ZaberTable(bench.link("turntable"), 1000.0)
    bench.line.firmware = ZaberFirmware(bench.spindle, stage="linear")
    with pytest.raises(WrongDevice, match="has 0 microsteps a turn"):
        bench.connect()
    slider = ElliptecBench()
    slider.line.firmware = ElliptecFirmware(slider.spindle, kind=0x09)
    with pytest.raises(WrongDevice, match="an ELL9 with a travel of 360 answered"):
        slider.connect()


@BOTH
def test_not_arriving_speaks_of_the_rig(make: Callable[[], Bench]) -> None:
    bench = make()
    table = bench.connect(reach_s=2.0)
    table.home()
    with pytest.raises(
        NoAnswer, match=r"turntable did not reach 350\.0 deg in 2 s \(it (stands at [89]\d\.\d deg|is still turning)\)"
    ):
        table.move(np.deg2rad(350.0))


@BOTH
def test_a_stall_is_named_and_homing_heals_it(make: Callable[[], Bench]) -> None:
    bench = make()
    table = bench.connect()
    table.home()
    bench.spindle.sticks_at_deg = 50.0
    with pytest.raises(DeviceFault, match=r"stalled|mechanical time-out"):
        table.move(np.deg2rad(120.0))
    table.home()
    table.move(np.deg2rad(120.0))
    assert degrees(bench) == pytest.approx(120.0, abs=0.003)


RECOVERABLE: dict[str, Fault] = {
    "lost": lost,
    "late": late(0.6),
    "very late": late(1.2),
    "split": split(4),
    "split slowly": split(4, 0.6),
    "nuls": after(b"\0\0\0"),
    "garbage before": after(b"\x93\xfe\x07\r\n"),
    "garbled": garbled(1),
    "garbled end": garbled(-1, 0x01),
}


@BOTH
@pytest.mark.parametrize("name", RECOVERABLE)
@pytest.mark.parametrize("place", range(2, 9))
def test_one_bad_answer_does_not_stop_or_misplace_it(make: Callable[[], Bench], name: str, place: int) -> None:
    bench = make()
    bench.line.answer_faults.extend([None] * place + [RECOVERABLE[name]])
    table = bench.connect()
    table.home()
    for angle in (120.0, 240.0):
        table.move(np.deg2rad(angle))
        assert degrees(bench) == pytest.approx(angle, abs=0.003)
        assert not bench.spindle.busy(bench.now())


@BOTH
@pytest.mark.parametrize("place", range(1, 8))
def test_one_lost_command_is_given_again(make: Callable[[], Bench], place: int) -> None:
    bench = make()
    bench.line.command_faults.extend([None] * place + [lambda _: b""])
    table = bench.connect()
    table.home()
    for angle in (120.0, 240.0):
        table.move(np.deg2rad(angle))
        assert degrees(bench) == pytest.approx(angle, abs=0.003)


@BOTH
def test_unplugging(make: Callable[[], Bench]) -> None:
    bench = make()
    table = bench.connect()
    bench.line.unplug()
    with pytest.raises(Unplugged, match="turntable"):
        table.home()
    table.close()
    bench.line.plug()
    bench.connect().home()


# ---- Zaber


def test_a_power_cut_is_named_and_homing_heals_it() -> None:
    bench = TableBench()
    table = bench.connect()
    table.home()
    bench.line.power_cycle()
    bench.clock.sleep(1.0)
    with pytest.raises((DeviceFault, NoAnswer)):  # its checksums are off again as well: nothing it says is trusted
        table.move(np.deg2rad(120.0))
    table = bench.connect()
    with pytest.raises(DeviceFault, match=r"does not know where it stands \(WR\).*home it"):
        table.move(np.deg2rad(120.0))
    table.home()
    table.move(np.deg2rad(120.0))


def test_a_power_cut_in_mid_turn_does_not_count_as_arrived() -> None:
    bench = TableBench()
    table = bench.connect()
    table.home()
    bench.line.answer_faults.extend([None, None, lambda data: (bench.line.power_cycle(), [])[1]])
    with pytest.raises((DeviceFault, NoAnswer)):
        table.move(np.deg2rad(180.0))


@pytest.mark.parametrize(
    ("what", "message"), [("driver_on", "switched its driver off"), ("emergency_stop", "emergency stop")]
)
def test_faults_are_named(what: str, message: str) -> None:
    bench = TableBench()
    firmware = ZaberFirmware(bench.spindle)
    bench.line.firmware = firmware
    table = bench.connect()
    table.home()
    setattr(firmware, what, what == "emergency_stop")
    with pytest.raises((DeviceFault, DeviceRefused), match=message):
        table.move(1.0)


def test_what_has_no_checksum_is_not_trusted_once_checksums_are_on() -> None:
    """Not even with the number of the present command."""
    bench = TableBench()
    table = bench.connect()
    table.home()
    number = f"{(table._id + 1) % 100:02d}"
    bench.line.answer_faults.append(after(f"@01 1 {number} OK IDLE -- 77\r\n".encode()))
    assert table.angle_rad() == 0.0


def test_answers_to_older_commands_are_recognised_by_their_number() -> None:
    bench = TableBench()
    table = bench.connect()
    table.home()
    body = f"01 1 {table._id:02d} OK IDLE -- 77"
    bench.line.answer_faults.append(after(f"@{body}:{checksum(body)}\r\n".encode()))
    assert table.angle_rad() == 0.0


@BOTH
def test_standing_still_elsewhere_is_not_arriving(make: Callable[[], Bench]) -> None:
    bench = make()
    table = bench.connect()
    table.home()
    bench.spindle.on_move = lambda angle: setattr(bench.spindle, "angle_deg", angle - 1.0)
    with pytest.raises(DeviceFault, match=r"turntable stopped at 119\.0+ deg instead of 120\.0+ deg"):
        table.move(np.deg2rad(120.0))


def test_bad_checksums_are_dropped_by_both_sides() -> None:
    firmware = ZaberFirmware(Spindle())
    assert firmware.feed(b"/1 1 00 get pos:2D\r\n", 0.0) == []
    assert firmware.feed(b"/1 1 00 get pos:2C\r\n", 0.0)[0][1] == b"@01 1 00 OK IDLE WR 0\r\n"
    bench = TableBench()
    table = bench.connect()
    body = "01 1 {:02d} OK IDLE -- 999"
    wrong = [body.format((table._id + k) % 100) for k in (1, 2, 3)]
    bench.line.answer_faults.extend([lambda _, b=b: [(0.0, f"@{b}:00\r\n".encode())] for b in wrong])  # type: ignore[misc]
    assert all(checksum(b) != "00" for b in wrong)
    with pytest.raises(NoAnswer, match="did not answer 'get pos'"):
        table.angle_rad()


def test_an_old_firmware_without_checksums_still_turns() -> None:
    """It rejects the setting that would switch them on; what it says without them is trusted."""
    bench = TableBench()
    firmware, asked = ZaberFirmware(bench.spindle), list[bytes]()
    bench.line.firmware = firmware
    del firmware.settings["comm.checksum"]
    bench.line.command_faults.extend([lambda data: (asked.append(data), data)[1]] * 20)
    table = bench.connect()
    assert any(b"set comm.checksum 1" in command for command in asked)
    assert "comm.checksum" not in firmware.settings
    table.home()
    table.move(np.deg2rad(120.0))
    assert degrees(bench) == pytest.approx(120.0, abs=0.003)
    assert table.angle_rad() == pytest.approx(np.deg2rad(120.0), abs=1e-4)


def test_other_messages_are_skipped() -> None:
    bench = TableBench()
    table = bench.connect()
    bench.line.answer_faults.append(after(b"!01 1 IDLE --\r\n#01 0 some information\r\n@02 1 01 OK IDLE -- 5\r\n"))
    assert table.angle_rad() == pytest.approx(np.deg2rad(30.0))


# ---- Elliptec


def test_elliptec_wire_format() -> None:
    """From Thorlabs's protocol: identity, position of a quarter turn (143360 pulses a turn), busy."""
    firmware = ElliptecFirmware(Spindle())
    assert firmware.feed(b"0in", 0.0)[0][1] == b"0IN0E11400609202317010168" + b"00023000\r\n"
    ((duration, answer),) = firmware.feed(b"0ma00008C00", 1.0)
    assert answer == b"0PO00008C00\r\n"
    assert duration == pytest.approx(2.3)
    assert firmware.feed(b"0gs", 1.5)[0][1] == b"0GS09\r\n"
    assert firmware.feed(b"0gs", 4.0)[0][1] == b"0GS00\r\n"
    assert firmware.feed(b"0zz", 4.0)[0][1] == b"0GS03\r\n"
    assert firmware.feed(b"1gs", 4.0) == []
    assert firmware.feed(b"0m", 4.0) == []
    assert firmware.feed(b"0gs", 7.0)[0][1] == b"0GS01\r\n"


def test_closing_stops_a_move_that_was_interrupted_and_is_no_fault_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while somebody's sleeve is in the table."""
    bench = TableBench()
    table = bench.connect()
    table.home()
    begun, sleep = bench.now(), bench.clock.sleep

    def interrupted(seconds: float) -> None:
        sleep(seconds)
        if bench.now() > begun + 0.3:
            raise KeyboardInterrupt

    monkeypatch.setattr(bench.clock, "sleep", interrupted)
    with pytest.raises(KeyboardInterrupt):
        table.move(np.deg2rad(180))
    monkeypatch.undo()
    assert bench.spindle.busy(bench.now())
    table.close()
    assert not bench.spindle.busy(bench.now()) and 0.0 < degrees(bench) < 170.0
    again = bench.connect()
    again.home()
    again.move(np.deg2rad(90))
    assert degrees(bench) == pytest.approx(90.0, abs=0.003)
