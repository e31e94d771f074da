"""The armed self-test with a device that falls silent or a supervisor that is killed: how long light is let out then.

Real drivers and supervisors, emulated devices on pseudo-terminals in real time.
"""

from __future__ import annotations

import os
import signal
import time
from types import SimpleNamespace

import pytest
from rig_fakes import emulation
from rig_programs import GATE, Bench, devices, started
from supervisor_fakes import supervisors_of

from hw.base.errors import DeviceFault, InputError
from hw.devices.omicron import OmicronLaser
from hw.rig.connect import Connector
from hw.rig.rig_file import ElliptecDevice, ZaberDevice
from hw.rig.rig_rules import load_rig_file
from hw.rig.selftest import _test_table, selftest
from hw.safety.signals import interruptible

__all__ = ["devices"]

METER = '[power_meter]\nkind = "ophir"\nport = "/dev/ttyMETER"\n'


def test_the_gate_is_shut_before_a_laser_that_falls_silent_is_told_to_go_off(
    devices: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is asked for seconds before that is given up. Expected: not with its gate open."""
    emulated, _, rig = devices
    stop, lines = OmicronLaser.stop_emission, []

    def fall_silent(head: OmicronLaser) -> None:
        lines.append(emulated.bench.board.lines & GATE)
        with monkeypatch.context() as silent:  # it is back when the driver has given it up, for the supervisor
            silent.setattr(emulated.cables["laser0"].firmware, "feed", lambda data, now: [])
            stop(head)

    monkeypatch.setattr(OmicronLaser, "stop_emission", fall_silent)
    found = {f.name: f for f in selftest(load_rig_file(rig), None, armed=True)}["laser 635 nm"]
    assert not found.good and "did not answer ?LOf" in found.text
    assert lines == [0] and emulated.bench.board.lines == 0


def test_no_laser_is_armed_on_a_rig_that_failed_in_the_dark(devices: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """A gate that does not follow may stand open. Expected: the laser behind it never emits."""
    _, _, rig = devices
    emitted: list[OmicronLaser] = []
    monkeypatch.setattr(OmicronLaser, "emit", emitted.append)

    def fails(*_: object) -> str:
        raise InputError("line 0 does not follow")

    monkeypatch.setattr("hw.rig.selftest._test_lines", fails)
    found = {f.name: f for f in selftest(load_rig_file(rig), None, armed=True)}
    assert not found["gates"].good and not emitted
    assert not found["laser 635 nm"].good and "not armed, since this failed: gates" in found["laser 635 nm"].text


def test_a_power_meter_is_looked_for_before_a_laser_emits(devices: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that does not answer is asked for seconds. Expected: in the dark; its reading behind the open gate."""
    emulated, _, rig = devices
    rig.write_text(rig.read_text() + METER)
    bench, met = emulated.bench, []

    class Meter:
        def __init__(self) -> None:
            met.append(("found", bench.board.lines & GATE, bench.heads[0].on_since is not None))

        def read(self) -> float:
            met.append(("read", bench.board.lines & GATE, bench.heads[0].on_since is not None))
            return 0.0095

        def close(self) -> None:
            met.append(("closed", bench.board.lines & GATE, bench.heads[0].on_since is not None))

    monkeypatch.setattr(Connector, "meter", lambda self: Meter())
    found = {f.name: f for f in selftest(load_rig_file(rig), None, armed=True)}["laser 635 nm"]
    assert found.good and "power meter 9.50 mW" in found.text
    assert met == [("found", 0, False), ("read", GATE, True), ("closed", 0, False)]


def test_a_light_that_stays_on_behind_the_gate_is_seen(devices: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """The laser's own word is not enough: the gate is opened once more for the photodiode."""
    emulated, _, rig = devices
    board, stopped = emulated.bench.board, []
    sample, stop = board.sample, OmicronLaser.stop_emission
    monkeypatch.setattr(OmicronLaser, "stop_emission", lambda head: (stopped.append(True), stop(head))[1])
    monkeypatch.setattr(board, "sample", lambda pin: 300 if stopped and board.lines & GATE else sample(pin))
    found = {f.name: f for f in selftest(load_rig_file(rig), None, armed=True)}["laser 635 nm"]
    assert not found.good and "reads 300 counts while it is off (allowed: 8)" in found.text
    assert board.lines == 0


def test_a_photodiode_that_is_not_dark_is_named(devices: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before any laser emits: daylight, or an amplifier's offset."""
    emulated, _, rig = devices
    monkeypatch.setattr(emulated.bench.board, "sample", lambda pin: 9)
    found = {f.name: f for f in selftest(load_rig_file(rig), None, armed=False)}["photodiode, dark"]
    assert not found.good
    assert "pin 0: the photodiode of laser 635 nm reads 9 counts with every gate shut (allowed: 8)" in found.text
    monkeypatch.setattr(emulated.bench.board, "sample", lambda pin: 8)
    assert {f.name: f for f in selftest(load_rig_file(rig), None, armed=False)}["photodiode, dark"].good


def test_a_supervisor_that_is_killed_in_the_warm_up_ends_it(devices: Bench) -> None:
    """Rationale: nobody would switch the laser off. Expected: off long before the minute of the warm-up is over."""
    emulated, _, rig = devices
    rig.write_text(rig.read_text().replace("warm_up_s = 0.0", "warm_up_s = 60.0"))
    head = emulated.bench.heads[0]
    process = started(["rig", "selftest", str(rig), "--arm"])
    end = time.monotonic() + 40.0
    while head.on_since is None and time.monotonic() < end:
        time.sleep(0.02)
    time.sleep(0.7)
    assert head.on_since is not None
    (supervisor,) = supervisors_of(process.pid)
    os.kill(supervisor, signal.SIGKILL)
    begun = time.monotonic()
    out, err = process.communicate(timeout=40)
    assert time.monotonic() - begun < 20.0 and head.on_since is None
    assert process.returncode == 1 and "FAIL" in out and "Traceback" not in err, out + err


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_signal_that_python_lost_ends_the_warm_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python swallows what is raised in a `__del__`."""

    class Lost:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    emulated = emulation()
    rig = emulated.serial_rig()
    rig.file = rig.file.model_copy(update={"warm_up_s": 3600.0})
    begun, emit = emulated.clock.now(), OmicronLaser.emit
    monkeypatch.setattr(OmicronLaser, "emit", lambda head: (emit(head), Lost())[0])
    with interruptible(), pytest.raises(KeyboardInterrupt), rig:
        pass
    assert emulated.clock.now() - begun < 60
    assert emulated.bench.light() == [] and not any(head.on_since for head in emulated.bench.heads)


@pytest.mark.parametrize(("kind", "device"), [("zaber", ZaberDevice), ("elliptec", ElliptecDevice)])
def test_a_table_that_is_off_names_a_key_that_it_has(kind: str, device: type[ZaberDevice | ElliptecDevice]) -> None:
    link = SimpleNamespace(error=lambda error, problem, remedy: error("COM1", "the turntable", problem, remedy))
    table = SimpleNamespace(link=link, home=lambda: None, move=lambda angle: None, angle_rad=lambda: 1.0)
    with pytest.raises(DeviceFault) as caught:
        _test_table(kind, table)  # type: ignore[arg-type]
    assert caught.value.remedy.split()[1] in device.model_fields
