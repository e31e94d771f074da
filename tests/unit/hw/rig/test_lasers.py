"""The lasers' own readings before every view: written down, refused beyond the tolerance, marked on drift."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from rig_fakes import at_image, emulation
from twin_fakes import PLAN, RIG

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.emulation.emulated_rig import Emulation
from hw.base.errors import DeviceFault, Refused
from hw.interface import LaserReading, gate_open
from pipeline.capture.laser_log import LASERS, LaserRow, append_lasers, drifts, read_lasers
from pipeline.capture.loop import capture
from pipeline.capture.quality import examine
from pipeline.stream.stream import StreamReader

SENSOR = lars3_sensor(RIG)


def test_lasers_are_read_before_every_view_and_written_down(tmp_path: Path) -> None:
    emulated = emulation()
    capture(emulated.serial_rig(), PLAN, tmp_path)
    rows = read_lasers(tmp_path)
    assert [(row.view, row.laser) for row in rows] == [(view, k) for view in range(PLAN.views) for k in range(3)]
    assert all(row.set_w == 0.01 and row.own_w == pytest.approx(0.01) and row.dark_w == 0.0 for row in rows)
    assert drifts(rows) == dict.fromkeys(range(PLAN.views), 0.0)


def weaken(emulated: Emulation, laser: int, share: float) -> None:
    """The head gives less than it is set to; what comes through its gate does not change (its reading is asked for)."""
    firmware = emulated.cables[f"laser{laser}"].firmware
    feed = firmware.feed

    def weaker(data: bytes, now: float) -> list[tuple[float, bytes]]:
        return [
            (t, re.sub(rb"(?<=!MDP)[0-9.]+", lambda m: b"%.4f" % (share * float(m[0])), a)) for t, a in feed(data, now)
        ]

    firmware.feed = weaker  # type: ignore[method-assign]


def test_a_laser_that_fails_during_the_scan_stops_it_at_the_next_view(tmp_path: Path) -> None:
    emulated = emulation()
    at_image(emulated, 2, lambda: weaken(emulated, 1, 0.8))
    with pytest.raises(DeviceFault, match=r"laser 532 nm emits 8.00 mW instead of 10 mW \(allowed: 10 % off\)"):
        capture(emulated.serial_rig(), PLAN, tmp_path)
    views = {row.view for row in read_lasers(tmp_path)}
    with StreamReader(tmp_path) as stored:
        assert views == {0} and PLAN.address(len(stored)).view == 1  # no image of the next view was taken
    assert not any(head.on_since for head in emulated.bench.heads)


def test_a_laser_that_drifts_is_marked(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    emulated = emulation()
    at_image(emulated, 2, lambda: weaken(emulated, 1, 0.95))
    capture(emulated.serial_rig(), PLAN, tmp_path)
    assert drifts(read_lasers(tmp_path)) == {0: 0.0} | dict.fromkeys(range(1, PLAN.views), pytest.approx(0.05))
    assert "view 1: a laser's own reading is 5.0 % off its first one" in caplog.text and "view 0:" not in caplog.text
    with StreamReader(tmp_path) as stored:
        marked = [any("own reading has drifted by 5.0 %" in r for r in v.remarks) for v in examine(stored, SENSOR)]
    assert marked == [False] + [True] * (PLAN.views - 1)


def test_one_garbled_power_reading_stops_nothing(tmp_path: Path) -> None:
    emulated = emulation()
    with emulated.serial_rig() as rig:
        emulated.cables["laser0"].answer_faults.append(lambda data: [(0.0, data.replace(b"10.", b"70."))])
        assert [reading.own_w for reading in rig.check()] == pytest.approx([0.01] * 3)


def test_a_gate_that_is_told_shut_and_leaks_is_refused() -> None:
    emulated = emulation()
    with emulated.serial_rig() as rig:
        emulated.bench.board.sample = lambda pin: 9 if pin == 2 else 8
        with pytest.raises(
            DeviceFault, match=r"photodiode of laser 476 nm reads 9 counts with every gate shut.*Remedy"
        ):
            rig.check()
        emulated.bench.board.sample = lambda pin: 8
        assert [reading.dark_w for reading in rig.check()] == [8 * device.watts_per_count for device in rig.file.lasers]
        with (
            gate_open(rig.lasers[0]),
            pytest.raises(Refused, match="checked in the dark, and the gate of laser 0 is open"),
        ):
            rig.check()


def test_the_table_of_readings_survives_a_crash_in_its_last_line(tmp_path: Path) -> None:
    readings = [LaserReading(0.01, 0.0101, 0.0), LaserReading(0.01, 0.0, 1e-5)]
    append_lasers(tmp_path, 0, 1.5, readings)
    whole = (tmp_path / LASERS).read_bytes()
    (tmp_path / LASERS).write_bytes(whole[:-5])
    append_lasers(tmp_path, 0, 2.5, readings)
    assert [(r.time_s, r.laser, r.own_w) for r in read_lasers(tmp_path)][-2:] == [(2.5, 0, 0.0101), (2.5, 1, 0.0)]
    assert (tmp_path / LASERS).read_text().count("view,time_s") == 1
    append_lasers(tmp_path, 1, 3.5, ())
    assert max(r.view for r in read_lasers(tmp_path)) == 0
    assert read_lasers(tmp_path / "none") == []
    assert drifts(read_lasers(tmp_path))[0] == float("inf")  # a laser that began at nothing
    later = LaserRow(2, 4.5, 0, 0.01, float("nan"), 0.0)
    assert drifts([LaserRow(0, 1.5, 0, 0.01, 0.01, 0.0), later]) == {
        0: 0.0,
        2: float("inf"),
    }  # no number is no drift of 0
