"""Safety of the serial rig: arming, read-back, a board that was reset, everybody told before anybody has to confirm."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from capture_fakes import contents
from rig_fakes import at_image, at_message, emulation, reset
from twin_fakes import PLAN, RIG, Glow

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.emulation.emulated_rig import open_scene_rig
from disco_twin.emulation.rig_file_of import rig_file_of
from disco_twin.emulation.twin_rig import TwinRig
from hw.base.errors import DeviceFault, DiscoError, Refused, SwitchedOff, Unplugged
from hw.interface import gate_open
from hw.rig.rig_rules import load_rig_file
from hw.rig.serial_rig import SerialRig
from hw.serial.bytelog import ByteLog
from pipeline.capture.loop import capture

SENSOR = lars3_sensor(RIG)


def test_a_board_that_was_reset_never_gives_an_image(tmp_path: Path) -> None:
    """It forgets gates and mirrors. In an exposure, in the floodlight, and after the mirrors have been aimed."""
    whole = tmp_path / "whole"
    capture(TwinRig(RIG, Glow(), seed=5), PLAN, whole)
    for number, when in enumerate(("exposure", "floodlight", "aimed")):
        emulated, parts = emulation(), tmp_path / when
        if when == "aimed":  # the lines are read (2) before the gate opens for the second spot
            at_message(emulated, lambda data, n: n == 6 and data[:1] == b"\x02", lambda e=emulated: reset(e))  # type: ignore[misc]
        else:
            at_image(emulated, 1 if when == "floodlight" else 4, emulated.cables["board"].power_cycle)
        with pytest.raises(DiscoError, match="Remedy"):
            capture(emulated.serial_rig(), PLAN, parts)
        assert emulated.bench.light() == [] and not any(h.on_since for h in emulated.bench.heads)
        assert capture(emulation().serial_rig(), PLAN, parts) == (3, 0, 4)[number]
        assert contents(parts) == contents(whole)


def test_a_reset_that_hides_behind_a_lost_answer_is_made_good(tmp_path: Path) -> None:
    """The command that opens the gate for the second spot is lost in a reset: aimed anew, the image is right."""
    whole, serial = tmp_path / "whole", tmp_path / "serial"
    capture(TwinRig(RIG, Glow(), seed=5), PLAN, whole)
    emulated = emulation()
    opening = b"\0\0\0\x01"
    at_message(emulated, lambda data, n: n == 6 and data[:4] == opening and data[4] & 7 > 0, lambda: reset(emulated))
    capture(emulated.serial_rig(), PLAN, serial)
    assert contents(serial) == contents(whole)


def test_everybody_is_told_before_anybody_has_to_confirm() -> None:
    """A board that has fallen silent must not delay the lasers."""
    emulated = emulation()
    rig = emulated.serial_rig()
    rig.__enter__()
    emulated.cables["board"].answer_faults.extend([lambda data: []] * 99)
    begun, off = emulated.clock.now(), []
    for head in emulated.bench.heads:
        assert head.on_since is not None
    sleep = emulated.clock.sleep

    def watched(seconds: float) -> None:
        sleep(seconds)
        if not off and all(head.on_since is None for head in emulated.bench.heads):
            off.append(emulated.clock.now())

    emulated.clock.sleep = watched  # type: ignore[method-assign]
    rig.make_safe()
    assert off and off[0] - begun < 0.1
    assert emulated.bench.board.lines == 0


def test_one_gate_at_a_time_and_none_during_moves() -> None:
    emulated = emulation()
    with emulated.serial_rig() as rig:
        with gate_open(rig.lasers[1]):
            with pytest.raises(Refused, match="one laser at a time"):
                rig.lasers[0].open_gate()
            for move in (lambda: rig.projector.move(1, 2), lambda: rig.turntable.move(0.0)):
                with pytest.raises(Refused, match="must not move while the gate of laser 1 is open"):
                    move()
        with pytest.raises(RuntimeError), gate_open(rig.lasers[2]):
            raise RuntimeError
        assert emulated.bench.light() == []
    assert emulated.bench.hazards == []


@pytest.mark.parametrize("make", ["serial", "assembled"])
def test_no_script_lights_a_laser_that_was_not_armed(make: str, tmp_path: Path) -> None:
    """Rationale: --arm is asked for by the command; a script that builds the rig itself must say it, too.

    Expected: the rig is refused before a byte is said to any device; nothing but real lasers needs permission.
    """
    emulated = emulation()
    said: list[bytes] = []
    for line in emulated.cables.values():
        line.receive = said.append  # type: ignore[method-assign]
    model = emulated.serial_rig()
    if make == "serial":
        rig = SerialRig(model._connector, emulated.bench.cameras, armed=False)
        with pytest.raises(Refused, match=r"not armed.*Remedy.*--arm"):
            capture(rig, PLAN, tmp_path)
        assert said == [] and not rig.connected
        return
    (tmp_path / "rig.toml").write_text(rig_file_of(RIG, {"laser1": "/dev/ttyNOBODY"}))
    file = load_rig_file(tmp_path / "rig.toml")
    with (
        open_scene_rig(file, RIG, TwinRig(RIG, Glow(), seed=5), armed=False) as rig,
        pytest.raises(Refused, match="--arm"),
    ):
        rig.__enter__()
    with (
        open_scene_rig(file, RIG, TwinRig(RIG, Glow(), seed=5), armed=True) as rig,
        pytest.raises(Unplugged, match="NOBODY"),
    ):
        rig.__enter__()


@pytest.mark.parametrize(
    ("counts", "limits", "says"),
    [
        (
            1023,
            (0.1, 5.0),
            r"gives 20.00 mW \(1023 counts\) .* instead of 10 mW \(the converter is at its top\)",
        ),
        (
            768,
            (0.1, 1.5),
            r"gives 15.01 mW \(768 counts\) .* instead of 10 mW \(allowed: 1 to 15 mW\)\. Remedy",
        ),
        (
            51,
            (0.1, 1.5),
            r"gives 1.00 mW \(51 counts\) .* instead of 10 mW \(allowed: 1 to 15 mW\)\. Remedy",
        ),
        (767, (0.1, 1.5), None),
        (52, (0.1, 1.5), None),
    ],
)
def test_the_photodiodes_limits(counts: int, limits: tuple[float, float], says: str | None) -> None:
    emulated = emulation()
    rig = emulated.serial_rig()
    lasers = tuple(laser.model_copy(update={"photodiode_limits": limits}) for laser in rig.file.lasers)
    rig.file = rig.file.model_copy(update={"lasers": lasers})
    with rig, gate_open(rig.lasers[1]):
        emulated.bench.board.sample = lambda pin: counts if pin == 1 else 0
        if says is None:
            assert rig.photodiode.read() == counts * rig.file.lasers[1].watts_per_count
            return
        with pytest.raises(DeviceFault, match=says):
            rig.photodiode.read()


def test_the_photodiode_is_compared_with_the_set_point() -> None:
    emulated = emulation()
    with emulated.serial_rig() as rig, gate_open(rig.lasers[0]):
        rig.cameras[0].expose()
        emulated.bench.heads[0].set_interlock(closed=False)
        with pytest.raises(DeviceFault, match=r"gives 0.00 mW \(0 counts\) at the photodiode instead of 10 mW"):
            rig.photodiode.read()


# ---- a board that falls silent while a gate is open


@pytest.mark.parametrize("deaf", [False, True])
def test_light_is_gone_at_once_when_an_image_fails_before_a_silent_board(deaf: bool) -> None:
    """Mute: it hears and does not answer; deaf: it does not even hear. The lasers must not wait for it."""
    emulated = emulation()
    with pytest.raises(DiscoError), emulated.serial_rig() as rig, gate_open(rig.lasers[0]):  # noqa: PT012 - a gate block
        assert emulated.bench.light() == [0]
        line = emulated.cables["board"]
        line.answer_faults.extend([lambda data: []] * 99)
        if deaf:
            line.command_faults.extend([lambda data: b""] * 99)
        begun, dark, sleep = emulated.clock.now(), [], emulated.clock.sleep

        def watched(seconds: float) -> None:
            sleep(seconds)
            if not dark and not any(head.on_since for head in emulated.bench.heads):
                dark.append(emulated.clock.now())

        emulated.clock.sleep = watched  # type: ignore[method-assign]
        raise DiscoError("the camera failed")
    assert dark and dark[0] - begun < 0.1


def test_an_answer_lost_in_the_light_puts_it_out_before_anything_is_repeated() -> None:
    emulated, cause = emulation(), "lost an answer while a gate was open"  # and no reset
    with pytest.raises(DeviceFault, match=cause), emulated.serial_rig() as rig, gate_open(rig.lasers[0]):  # noqa: PT012 - a gate block
        emulated.cables["board"].command_faults.append(lambda data: b"")
        begun = emulated.clock.now()
        dark = []
        receive = emulated.cables["laser0"].receive

        def told(data: bytes) -> None:
            receive(data)
            if b"LOf" in data:
                dark.append(emulated.clock.now())

        emulated.cables["laser0"].receive = told  # type: ignore[method-assign]
        rig.photodiode.read()
    assert dark[0] - begun < 0.3  # the 0.2 s after which an answer counts as lost, and no repetition


def test_an_opening_whose_answer_was_lost_is_not_repeated_before_aiming_anew() -> None:
    emulated = emulation()
    sent: list[bytes] = []
    with emulated.serial_rig() as rig:
        rig.projector.move(100, 200)
        line = emulated.cables["board"]
        receive = line.receive

        def received(data: bytes) -> None:
            sent.append(data)
            opening = data[:4] == b"\0\0\0\x01" and data[4] & 7
            if opening and sum(d == data for d in sent) == 1:
                return
            receive(data)

        line.receive = received  # type: ignore[method-assign]
        rig.lasers[0].open_gate()
        rig.lasers[0].close_gate()
    openings = [i for i, d in enumerate(sent) if d[:4] == b"\0\0\0\x01" and d[4] & 7]
    assert any(d[:1] == b"\x03" for d in sent[openings[0] : openings[1]])


def test_no_gate_opens_and_no_image_counts_once_everything_was_made_dark(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lasers are real, the board is emulated: it would go on answering."""
    emulated = emulation()

    def gone() -> None:
        raise SwitchedOff("supervisor", "the rig", "is dark: the program was stopped", "none")

    with emulated.serial_rig() as rig, monkeypatch.context() as dark:
        dark.setattr("hw.rig.serial_rig.require_supervisor", gone)
        with pytest.raises(SwitchedOff, match="the program was stopped"):
            rig.lasers[0].open_gate()
        assert not emulated.bench.board.lines & 7
    with emulated.serial_rig() as rig, pytest.raises(SwitchedOff), gate_open(rig.lasers[0]):  # noqa: PT012 - a gate block
        monkeypatch.setattr("hw.rig.serial_rig.require_supervisor", gone)
        rig.photodiode.read()
    assert emulated.bench.light() == [] and emulated.bench.hazards == []


def test_no_gate_opens_before_the_rig_is_entered_anew_when_the_light_was_cut() -> None:
    """The lasers were told off: their gates would let out nothing, or what a laser that did not hear still emits."""
    emulated = emulation()
    with emulated.serial_rig() as rig:
        rig.darken()
        with pytest.raises(
            DeviceFault, match=r"lost an answer while a gate was open: the lasers were switched off.*Remedy"
        ):
            rig.lasers[0].open_gate()
        assert not emulated.bench.board.lines & 7
    with rig:
        rig.lasers[0].open_gate()
        assert emulated.bench.light() == [0]
        begun = emulated.clock.now()
        rig.lasers[0].darken()
        rig.lasers[0].close_gate()
        assert emulated.clock.now() - begun < 0.1  # its echo to the hurried word does not answer the next


def test_a_full_disk_ends_the_log_and_nothing_else(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    log = ByteLog(tmp_path / "full.log")
    log._file.close()
    log._file = Path("/dev/full").open("a", encoding="ascii", buffering=1)  # noqa: SIM115 - the log closes it
    log.note(0.0, ">", b"1")
    log.note(1.0, ">", b"2")
    log.close()
    assert caplog.text.count("the byte log ends here") == 1


def test_no_failure_of_a_step_keeps_the_rig_from_being_made_safe() -> None:
    def full() -> None:
        raise OSError(28, "No space left on device")

    emulated = emulation()
    rig = emulated.serial_rig()
    rig.__enter__()
    rig.drivers().board.darken = full  # type: ignore[method-assign]
    rig.darken()  # says so, and goes on to the lasers
    assert not any(head.on_since for head in emulated.bench.heads)
    rig.make_safe()
    assert emulated.bench.board.lines == 0 and not rig.connected


@pytest.mark.parametrize("step", ["darken", "board", "head", "table"])
def test_ctrl_c_while_the_rig_is_made_safe_leaves_no_device_open(step: str) -> None:
    """It is heard in the end; every device is closed before. Called again, nothing is left."""
    emulated = emulation()
    rig = emulated.serial_rig()
    rig.__enter__()
    devices, closed = rig.drivers(), []
    parts = {"head": devices.lasers[0], "board": devices.board, "table": devices.table}
    for name, part in parts.items():
        close = part.close

        def spied(name: str = name, close: Callable[[], None] = close) -> None:
            if step == name and not pressed:
                pressed.append(name)
                signal.raise_signal(signal.SIGINT)
            close()
            closed.append(name)

        setattr(part, "close", spied)  # noqa: B010 - a spy on one device
    pressed: list[str] = []
    darken = devices.lasers[0].darken

    def off_spied() -> None:
        if step == "darken" and not pressed:
            pressed.append(step)
            signal.raise_signal(signal.SIGINT)
        darken()

    setattr(devices.lasers[0], "darken", off_spied)  # noqa: B010 - the same
    with pytest.raises(KeyboardInterrupt):
        rig.make_safe()
    assert sorted(closed) == ["board", "head", "table"]
    assert emulated.bench.board.lines == 0 and not any(head.on_since for head in emulated.bench.heads)
    rig.make_safe()
    assert len(closed) == 3


def test_a_supervisor_that_ends_while_lasers_warm_up_ends_it_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    emulated = emulation()
    rig = emulated.serial_rig()
    rig.file = rig.file.model_copy(update={"warm_up_s": 3600.0})
    begun = emulated.clock.now()

    def gone() -> None:
        if emulated.clock.now() - begun > 100:
            raise SwitchedOff("supervisor", "the rig", "is dark: it was killed", "see to it")

    monkeypatch.setattr("hw.rig.emission.require_supervisor", gone)
    with pytest.raises(SwitchedOff), rig:
        pass
    assert emulated.clock.now() - begun < 110
    assert emulated.bench.light() == [] and not any(head.on_since for head in emulated.bench.heads)


def test_what_interrupts_one_step_though_signals_wait_leaves_no_other_device_open() -> None:
    """Another signal's handler, of a script, may raise what it likes."""
    emulated = emulation()
    rig = emulated.serial_rig()
    rig.__enter__()
    devices = rig.drivers()

    def ended() -> None:
        raise SystemExit

    devices.lasers[0].darken = ended  # type: ignore[method-assign]
    with pytest.raises(SystemExit):
        rig.make_safe()
    assert emulated.bench.board.lines == 0 and not any(head.on_since for head in emulated.bench.heads)
    assert not rig.connected and not any(line._users for line in emulated.cables.values())
