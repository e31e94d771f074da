"""A program that is told to end while light is let out: gates, lamps and lasers are off, by whatever signal it was.

Programs of their own, real drivers and supervisors, emulated devices on pseudo-terminals in real time.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from rig_programs import (
    FLOOD,
    GATE,
    LAMP,
    ONE,
    Bench,
    at_pattern,
    said,
    started,
)

from disco_twin.emulation.emulated_rig import Emulation, open_scene_rig
from disco_twin.emulation.rig_file_of import rig_file_of
from hw.base.clock import VirtualClock, WallClock, side_by_side
from hw.base.errors import DeviceFault
from hw.devices.mm_ard import MirrorBoard
from hw.devices.omicron import OmicronLaser
from hw.devices.omicron_protocol import Mode
from hw.rig.connect import Connector
from hw.rig.rig_rules import load_rig_file
from hw.rig.serial_rig import SerialRig
from hw.safety.ports.protocol_supervised import LIFELINE

MOMENTS: dict[str, Callable[[int], bool]] = {
    "gate": lambda pattern: pattern == LAMP | GATE,
    "floodlight": lambda pattern: bool(pattern & FLOOD),
    "lamp": lambda pattern: pattern == LAMP,
}


@pytest.mark.timing
@pytest.mark.parametrize(
    "case",
    [f"selftest {case}" for case in ("SIGTERM gate", "SIGHUP gate", "SIGINT gate", "SIGQUIT gate", "SIGHUP lamp")]
    + [f"capture {case}" for case in ("SIGTERM gate", "SIGHUP gate", "SIGQUIT gate", "SIGTERM floodlight")]
    + ["selftest SIGTERM floodlight"],
)
def test_whatever_ends_it_leaves_gates_and_lamps_off(devices: Bench, tmp_path: Path, case: str) -> None:
    """Rationale: Python runs no `finally` at SIGTERM and SIGHUP. Expected: everything off, one line that says so."""
    command, number, moment = case.split()
    emulated, _, rig = devices
    out_folder, scene = tmp_path / "out", tmp_path / "scene.toml"
    words = ["rig", "selftest", str(rig), "--arm"]
    if command == "capture":
        words = ["capture", str(scene), "--out", str(out_folder), "--rig", str(rig), "--arm"]
    told: list[float] = []
    dark: list[float] = []
    process = started(words)

    def tell() -> None:
        told.append(time.monotonic())
        process.send_signal(signal.Signals[number])

    at_pattern(emulated, MOMENTS[moment], tell)
    at_pattern(emulated, lambda pattern: bool(told) and not pattern, lambda: dark.append(time.monotonic()))
    out, err = process.communicate(timeout=60)
    assert told, out + err
    assert emulated.bench.board.lines == 0 and not any(head.on_since for head in emulated.bench.heads), out + err
    assert dark[0] - told[0] < (1.0 if moment == "gate" else 3.0)  # lamps wait until the board is in step again
    assert process.returncode == 130 and said(err).startswith("disco-twin: stopped: "), err
    assert "FAIL" not in out and emulated.bench.hazards == []


def test_probe_is_ended_like_the_others(devices: Bench, tmp_path: Path) -> None:
    """It connects, and lights nothing: what another program left on is off, whenever the signal comes."""
    emulated, _, rig = devices
    process = started(["rig", "probe", str(rig)])
    emulated.bench.board.set_pattern(LAMP | FLOOD)
    at_pattern(emulated, lambda pattern: not pattern, lambda: process.send_signal(signal.SIGTERM))
    out, err = process.communicate(timeout=60)
    assert emulated.bench.board.lines == 0 and "mirror board" not in out and "turntable" not in out
    assert process.returncode == 130 and said(err).startswith("disco-twin: stopped: "), err


def serial_rig(rig: Path) -> SerialRig:
    """The rig of a file, in this process, without a camera."""
    return SerialRig(Connector(load_rig_file(rig)), [], armed=True)


@pytest.fixture
def whole(devices: Bench) -> Bench:
    """A rig file of all of them."""
    emulated, server, rig = devices
    rig.write_text(rig_file_of(ONE, server.urls))
    return emulated, server, rig


@pytest.mark.timing
def test_ports_that_were_all_pulled_are_closed_in_the_time_of_one(
    whole: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The supervisor goes on trying; it is waited for as long as for one port."""
    emulated, server, path = whole
    rig = serial_rig(path)
    rig.__enter__()
    supervisor = LIFELINE._supervisors[-1]
    with monkeypatch.context() as at_once:  # at the first of them the supervisor makes the others dark
        for cable in emulated.cables.values():
            at_once.setattr(cable, "receive", lambda data: None)
        for name in list(server.urls):
            server.unplug(name)
    begun = time.monotonic()
    rig.make_safe()
    assert 1.0 <= time.monotonic() - begun < 2.5 and not rig.connected
    heads = emulated.bench.heads
    assert all(head.on_since for head in heads)
    for name in emulated.cables:
        server.plug(name)
    assert supervisor.wait(10) == 0
    assert not any(head.on_since for head in heads)


def test_a_laser_that_has_fallen_silent_is_waited_for_once(whole: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its adapter lives: no write fails. Expected: one question's attempts (6 s here), then 1 s for the supervisor."""
    emulated, _, path = whole
    monkeypatch.setattr("hw.devices.omicron.ANSWER_S", 0.2)
    rig = serial_rig(path)
    rig.__enter__()
    rig.lasers[0].open_gate()
    firmware = emulated.cables["laser0"].firmware
    hear = firmware.feed
    firmware.feed = lambda data, now: []  # type: ignore[method-assign]
    begun = time.monotonic()
    rig.make_safe()
    assert time.monotonic() - begun < 13.0 and not rig.connected
    assert emulated.bench.board.lines == 0
    assert [head.on_since is not None for head in emulated.bench.heads] == [True, False, False]
    firmware.feed = hear  # type: ignore[method-assign]
    end = time.monotonic() + 5.0
    while any(head.on_since for head in emulated.bench.heads):
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.mark.timing
def test_the_gate_does_not_wait_for_a_laser_that_takes_no_bytes(whole: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Expected: gates and lamps shut at once, while telling the laser still fails."""
    emulated, _, path = whole
    rig = serial_rig(path)
    rig.__enter__()
    rig.lasers[0].open_gate()
    dark: list[float] = []
    at_pattern(emulated, lambda pattern: not pattern, lambda: dark.append(time.monotonic()))
    monkeypatch.setattr(OmicronLaser, "darken", lambda self: time.sleep(2.0))
    begun = time.monotonic()
    rig.make_safe()
    assert dark[0] - begun < 1.0


@pytest.mark.parametrize("moment", ["before", "after"])
def test_ctrl_c_in_closing_waits_until_all_are_off(whole: Bench, monkeypatch: pytest.MonkeyPatch, moment: str) -> None:
    """Twice, within the board's own closing, before and after it was told: gates, lamps and lasers are off first."""
    emulated, _, path = whole
    rig = serial_rig(path)
    rig.__enter__()
    rig.lasers[0].open_gate()
    shut, pressed = MirrorBoard.shut, []

    def interrupted(self: MirrorBoard) -> None:
        if moment == "after":
            shut(self)
        for _ in range(2):
            pressed.append(True)
            signal.raise_signal(signal.SIGINT)
        if moment == "before":
            shut(self)

    monkeypatch.setattr(MirrorBoard, "shut", interrupted)
    with pytest.raises(KeyboardInterrupt):
        rig.make_safe()
    assert len(pressed) == 2 and not rig.connected
    assert emulated.bench.board.lines == 0 and not any(head.on_since for head in emulated.bench.heads)
    rig.make_safe()
    assert len(pressed) == 2


def test_a_driver_that_is_closed_by_itself_is_not_interrupted_either(
    whole: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the self-test closes the board."""
    emulated, _, path = whole
    board = Connector(load_rig_file(path)).board()
    board.set_lines(LAMP | GATE)
    exchange = MirrorBoard._exchange

    def interrupted(self: MirrorBoard, command: bytes, *rest: object) -> bytes:
        signal.raise_signal(signal.SIGINT)
        return exchange(self, command, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(MirrorBoard, "_exchange", interrupted)
    with pytest.raises(KeyboardInterrupt):
        board.close()
    assert emulated.bench.board.lines == 0


@pytest.mark.timing
def test_steps_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """At once in real time, in order on a virtual clock, and all of them where the system gives no thread."""
    wall, clock, done = WallClock(), VirtualClock(), []

    def step(number: int, seconds: float = 0.3) -> Callable[[], None]:
        return lambda: (time.sleep(seconds), done.append(number))[0]

    begun = time.monotonic()
    side_by_side(wall, [step(k) for k in range(4)])
    assert sorted(done) == [0, 1, 2, 3] and time.monotonic() - begun < 0.9
    done.clear()
    side_by_side(clock, [step(k, 0.01) for k in range(4)])
    assert done == [0, 1, 2, 3]
    done.clear()

    def none_left(self: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr("threading.Thread.start", none_left)
    side_by_side(wall, [step(k, 0.0) for k in range(4)])
    assert done == [0, 1, 2, 3]


# ---- the black level


class Black:
    """A GenICam camera's place: shows a level, and keeps what fell into the rig when it was measured."""

    def __init__(self, emulated: Emulation, level: float) -> None:
        self.emulated, self.level, self.seen = emulated, level, []  # type: ignore[var-annotated]
        self.name, self.grabber, self.closed = "front", self, 0

    def identity(self) -> str:
        return "a fake camera"

    def black_level(self) -> tuple[float, float]:
        bench = self.emulated.bench
        on = [head.on_since for head in bench.heads if head.on_since is not None]
        self.seen.append((bench.board.lines, on))
        return self.level, 1.0

    def close(self) -> None:
        self.closed += 1


SENSOR = """
[[cameras]]
kind = "genicam"
name = "front"
address = "127.0.0.1"

[sensor]
longest_exposure_s = 0.01
exponents = [0, 3]
saturation_dn = 3900
black_dn = 64.0
gain_e_per_dn = 1.0
read_noise_e = 3.0
responsivity = [1e12, 1e12, 1e12]
"""


@pytest.mark.parametrize("level", [64.5, 70.0])
def test_the_black_level_is_measured_after_everything_was_switched_off(
    whole: Bench, monkeypatch: pytest.MonkeyPatch, level: float
) -> None:
    """Rationale: another program left lasers, gates and floodlight on. Expected: off by then, and after a refusal."""
    emulated, _, path = whole
    text = path.read_text()
    path.write_text(text[: text.index("[[cameras]]")] + SENSOR)
    camera = Black(emulated, level)
    monkeypatch.setattr("hw.rig.serial_rig.open_camera", lambda device, sensor, shape: camera)
    bench = emulated.bench
    bench.board.set_pattern(LAMP | FLOOD | GATE)
    for head in bench.heads:
        head.mode, head.level, head.on_since = int(Mode.BIAS | Mode.RELEASE), 1.0, bench.clock.now() - 60.0
    assert bench.light() == [0]
    with open_scene_rig(load_rig_file(path), ONE, armed=True) as rig:
        assert camera.seen == []
        if level == 64.5:
            with rig:
                assert camera.seen == [(0, [])] and all(head.on_since for head in bench.heads)
        else:
            with pytest.raises(
                DeviceFault, match=r"camera front shows 70.0 in the dark instead of 64 .*Remedy"
            ) as refused:
                rig.__enter__()
            assert "\n" not in str(refused.value) and camera.seen == [(0, [])]
        assert bench.board.lines == 0 and not any(head.on_since for head in bench.heads) and not rig.connected
    assert camera.closed == 1
