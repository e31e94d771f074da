"""The Omicron driver against the emulated laser: identity, power, emission, and every trap of its protocol."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from omicron_fakes import emitting
from serial_fakes import BoardBench, LaserBench, TableBench

from disco_twin.firmware.omicron import COMMANDS, LaserHead
from disco_twin.firmware.wire import garbled, late, lost
from hw.base.errors import DeviceFault, DeviceRefused, NoAnswer, WrongDevice
from hw.devices.omicron import OmicronLaser
from hw.devices.omicron_protocol import Mode, Status

# ---- identity


def test_it_says_who_it_is() -> None:
    laser = LaserBench().connect()
    assert (laser.identity.model, laser.identity.wavelength_nm, laser.identity.max_power_mw) == ("LuxX", 532.0, 100.0)


@pytest.mark.parametrize("make", [BoardBench, TableBench])
def test_another_device_on_the_port_is_refused(make: Callable[[], BoardBench | TableBench]) -> None:
    with pytest.raises(WrongDevice, match=r"laser 532 nm is not an Omicron laser of 532 nm.*Remedy.*rig probe"):
        OmicronLaser(make().link("laser 532 nm"), 532.0)


def test_another_laser_is_refused_with_what_answered() -> None:
    bench = LaserBench(head=LaserHead(476.0, 10.0))
    with pytest.raises(WrongDevice, match="is not an Omicron laser of 532 nm: a LuxX of 476 nm answered"):
        bench.connect()
    bench = LaserBench(head=LaserHead(532.0, 10.0, model="LedHUB", device_id=20))
    with pytest.raises(WrongDevice, match="LedHUB"):
        bench.connect()


# ---- power and emission


def test_connecting_switches_a_running_laser_off_for_good() -> None:
    """Also what would switch it on again: autostart, and what a power cut brings back."""
    head = LaserHead(532.0, 100.0, stored_level=0xFFF, stored_mode=0x6018)
    bench = LaserBench(head=head)
    assert head.switch_on(bench.now())
    bench.clock.sleep(10)
    assert head.emission(bench.now()) == 1.0
    bench.connect()
    assert head.emission(bench.now()) == 0.0
    bench.line.power_cycle()
    bench.clock.sleep(10)
    assert head.emission(bench.now()) == 0.0
    assert not head.stored_mode & (1 << 3 | 1 << 4 | 1 << 14)


@pytest.mark.parametrize("says_off", [False, True], ids=["its status says on", "only its photodiode tells"])
def test_a_laser_that_says_yes_and_stays_on_is_not_called_off(monkeypatch: pytest.MonkeyPatch, says_off: bool) -> None:
    """LOf, TPP and SOM are answered with yes, GOM with what was asked for, and none of them is obeyed."""
    for letters in ("LOf", "TPP", "SOM"):
        monkeypatch.setitem(COMMANDS, letters, lambda head, arguments, now: ">")
    monkeypatch.setitem(COMMANDS, "GOM", lambda head, arguments, now: "0000")
    if says_off:
        monkeypatch.setitem(COMMANDS, "GAS", lambda head, arguments, now: "02C0")
    bench = LaserBench(head=LaserHead(532.0, 100.0, stored_level=0xFFF))
    assert bench.head.switch_on(bench.now())
    bench.clock.sleep(10.0)
    with pytest.raises(DeviceFault, match=r"to go off, reports that it is o.* measures 100.00 mW \(allowed: 1\)"):
        bench.connect()


def test_no_light_before_it_is_armed_and_told_to_emit() -> None:
    bench = LaserBench()
    laser = bench.connect()
    with pytest.raises(DeviceRefused, match="is not armed"):
        laser.emit()
    laser.arm(40.0)
    bench.clock.sleep(10.0)
    assert bench.head.emission(bench.now()) == 0.0
    before = bench.now()
    laser.emit()
    assert 3.0 <= bench.now() - before < 3.3
    assert bench.head.emission(bench.now()) == pytest.approx(0.4)
    assert laser.measured_mw() == pytest.approx(40.0)
    assert Status.ON in laser.status()
    laser.stop_emission()
    assert bench.head.emission(bench.now()) == 0.0


def test_switched_off_it_has_to_be_armed_again() -> None:
    laser = emitting(LaserBench())
    laser.force_off()
    with pytest.raises(DeviceRefused, match="is not armed"):
        laser.emit()


def test_emission_is_waited_for_until_the_laser_measures_it() -> None:
    """A laser may say that it is on before its diode gives light."""
    bench = LaserBench()
    laser = bench.connect()
    laser.arm(40.0)
    shines, from_s = bench.head.emission, bench.now() + 5.0
    bench.head.emission = lambda now: shines(now) if now > from_s else 0.0  # type: ignore[method-assign]
    laser.emit()
    assert from_s < bench.now() < from_s + 0.3 and laser.measured_mw() == pytest.approx(40.0)


def test_the_power_may_be_off_by_its_tolerance_and_no_more() -> None:
    bench = LaserBench()
    laser = emitting(bench)
    for level, allowed in ((0.44, True), (0.4401, False), (0.36, True), (0.3599, False)):
        bench.head.level = level
        if allowed:
            assert laser.require_power(0.1) == pytest.approx(100.0 * level)
            continue
        with pytest.raises(DeviceFault, match=r"emits (44\.01|35\.99) mW instead of 40 mW \(allowed: 10 % off\)"):
            laser.require_power(0.1)


def test_a_mode_that_is_not_kept_is_refused() -> None:
    bench = LaserBench()
    laser = bench.connect()
    bench.line.command_faults.extend([lambda data: b"?SOM0008\r" if data.startswith(b"?SOM") else data] * 100)
    with pytest.raises(DeviceRefused, match=r"did not keep mode 0018.*Remedy"):
        laser.arm(40.0)
    with pytest.raises(DeviceRefused, match="is not armed"):
        laser.emit()


def test_one_garbled_failure_bit_stops_nothing() -> None:
    bench = LaserBench()
    laser = emitting(bench)
    bench.line.answer_faults.append(lambda data: [(0.0, data.replace(b"0000", b"0200"))])
    assert laser.faults() == []
    bench.head.fail(1 << 9)
    assert laser.faults() == ["the interlock is open"]


def test_a_reset_leaves_it_off_and_to_be_armed_again() -> None:
    """Its memory may hold what switches it on: a reset brings that back."""
    bench = LaserBench()
    laser = emitting(bench)
    bench.head.stored_level, bench.head.stored_mode = 0xFFF, int(Mode.BIAS | Mode.RELEASE | Mode.AUTOSTART)
    laser.reset()
    assert not bench.head.mode & (Mode.BIAS | Mode.RELEASE | Mode.AUTOSTART) and bench.head.level == 0.0
    with pytest.raises(DeviceRefused, match="is not armed"):
        laser.emit()


def test_a_laser_that_never_emits_is_given_up() -> None:
    bench = LaserBench()
    laser = bench.connect()
    laser.arm(40.0)
    bench.head.emission = lambda now: 0.0  # type: ignore[method-assign]
    begun = bench.now()
    with pytest.raises(NoAnswer, match=r"did not emit within 8 s\. Remedy: check key switch, interlock and enable pin"):
        laser.emit()
    assert 8.0 <= bench.now() - begun < 8.5


def test_arming_powers_a_laser_that_sleeps() -> None:
    bench = LaserBench()
    laser = bench.connect()
    assert laser.ask("POf") == ">"
    laser.arm(40.0)
    laser.emit()
    assert laser.measured_mw() == pytest.approx(40.0)


def test_the_port_of_a_laser_that_does_not_answer_is_given_back() -> None:
    bench, closed = LaserBench(), list[bool]()
    laser = bench.connect()
    bench.line.on_closed = lambda: closed.append(True)
    bench.line.answer_faults.extend([lost] * 99)
    with pytest.raises(NoAnswer):
        laser.close()
    assert closed == [True]


@pytest.mark.parametrize("power", [-1.0, 0.0, 100.1, float("nan")])
def test_powers_that_the_laser_does_not_have_are_refused(power: float) -> None:
    with pytest.raises(DeviceRefused, match="ask for more than 0 and at most 100 mW"):
        LaserBench().connect().arm(power)


def test_without_temporary_power_the_memory_is_spared() -> None:
    """TPP answers !UK: SLP is used instead, and only where the level changes."""
    bench = LaserBench(head=LaserHead(532.0, 100.0, knows_temporary_power=False))
    for _ in range(5):
        laser = bench.connect()
    assert bench.head.memory_writes == 0
    for _ in range(5):
        laser.arm(100.0)
    assert bench.head.memory_writes == 1
    laser.emit()
    assert laser.measured_mw() == 100.0


@pytest.mark.parametrize("fault", ["answer lost", "answer late", "answer garbled", "command lost"])
def test_a_lost_answer_does_not_write_the_memory_twice(fault: str) -> None:
    """Rationale: SLP is idempotent in what it sets and not in what it wears. Expected: one write, and the level set."""
    bench = LaserBench(head=LaserHead(532.0, 100.0, knows_temporary_power=False))
    laser = bench.connect()
    sent: list[bytes] = []
    answers = {"answer lost": lost, "answer late": late(0.7), "answer garbled": garbled(1)}

    def befall(data: bytes) -> bytes:
        if data.startswith(b"?SLP"):
            sent.append(data)
            if len(sent) == 1 and fault == "command lost":
                return b""
            if len(sent) == 1:
                bench.line.answer_faults.append(answers[fault])
        return data

    bench.line.command_faults.extend([befall] * 200)
    laser.arm(40.0)
    assert bench.head.memory_writes == 1 and len(sent) == (2 if fault == "command lost" else 1)
    assert bench.head.stored_level == round(0.4 * 0xFFF)
    laser.emit()
    assert laser.measured_mw() == pytest.approx(40.0, abs=0.02)


def test_a_level_that_is_not_kept_is_refused() -> None:
    bench = LaserBench(head=LaserHead(532.0, 100.0, knows_temporary_power=False))
    laser = bench.connect()
    bench.line.command_faults.extend([lambda data: b"?GLP\r" if data.startswith(b"?SLP") else data] * 200)
    with pytest.raises(DeviceRefused, match="did not keep level 666 in 3 attempts"):
        laser.arm(40.0)


# ---- interlock, key, reset


def test_an_interlock_that_opens_is_named_and_needs_a_reset() -> None:
    bench = LaserBench()
    laser = emitting(bench)
    bench.head.set_interlock(closed=False)
    assert bench.head.emission(bench.now()) == 0.0
    with pytest.raises(DeviceFault, match="the interlock is open"):
        laser.require_ready()
    with pytest.raises(DeviceFault, match=r"refused to emit: .*the interlock is open"):
        laser.emit()
    bench.head.set_interlock(closed=True)
    with pytest.raises(DeviceFault, match="only a reset clears it"):
        laser.require_ready()
    before = bench.now()
    laser.reset()
    assert 5.0 <= bench.now() - before < 6.0
    laser.arm(40.0)
    laser.emit()


def test_arming_resets_an_interlock_that_is_closed_again_and_no_other() -> None:
    bench = LaserBench()
    laser = emitting(bench)
    bench.head.set_interlock(closed=False)
    with pytest.raises(DeviceFault, match="the interlock is open"):
        laser.arm(40.0)
    bench.head.set_interlock(closed=True)
    laser.arm(40.0)
    laser.emit()
    bench.head.fail(1 << 12 | 1 << 0)
    with pytest.raises(DeviceFault, match="the diode's temperature is out of range"):
        laser.arm(40.0)


def test_the_key_is_named() -> None:
    bench = LaserBench()
    laser = emitting(bench)
    bench.head.set_key(on=False)
    assert bench.head.emission(bench.now()) == 0.0
    with pytest.raises(DeviceFault, match="key"):
        laser.require_ready()
    bench.head.set_key(on=True)
    laser.require_ready()
    bench.head.enabled = False
    with pytest.raises(DeviceFault, match="enable pin"):
        laser.require_ready()


def test_an_interlock_during_the_preheating_ends_the_wait_with_its_name() -> None:
    bench = LaserBench()
    laser = bench.connect()
    laser.arm(40.0)
    bench.line.answer_faults.append(lambda data: (bench.head.set_interlock(closed=False), [(0.0, data)])[1])
    with pytest.raises(DeviceFault, match="interlock"):
        laser.emit()


@pytest.mark.parametrize("reply", [b"!RsC\r", b"!RsC>\r"])
def test_both_answers_to_a_reset_are_accepted(reply: bytes) -> None:
    bench = LaserBench()
    laser = bench.connect()
    bench.line.answer_faults.append(lambda _: [(0.0, reply)])
    laser.reset()
    assert laser.status() & Status.POWERED


def test_a_power_cycle_resets_the_separator() -> None:
    bench = LaserBench()
    laser = bench.connect()
    assert laser.ask("GFw", "|") == "LuxX|4|1.90"
    assert laser.ask("GFw") == "LuxX|4|1.90"
    bench.line.power_cycle()
    assert laser.ask("GFw") == "LuxX\xa74\xa71.90"
