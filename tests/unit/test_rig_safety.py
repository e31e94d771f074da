"""Safety of the serial rig: arming, read-back, a board that was reset, everybody told before anybody has to confirm."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from capture_fakes import contents
from test_capture_twin import PLAN, RIG, Glow

from disco_twin.assembly import assembled
from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.cli import main
from disco_twin.firmware.emulate import Emulation
from disco_twin.rig import TwinRig
from disco_twin.rig_commands import rig_file_of, selftest, served
from disco_twin.rig_rules import load_rig_file
from hw.bytelog import ByteLog
from hw.errors import DeviceFault, DiscoError, Refused, SwitchedOff, Unplugged
from hw.interface import LaserReading, gate_open
from hw.rig import SerialRig
from pipeline.capture.lasers import LASERS, append_lasers, drifts, read_lasers
from pipeline.capture.loop import capture
from pipeline.capture.quality import examine
from pipeline.capture.stream import StreamReader
from pipeline.rig import RigConfig

SENSOR = lars3_sensor(RIG)


def emulation() -> Emulation:
    return Emulation(TwinRig(RIG, Glow(), seed=5))


def at_image(emulated: Emulation, number: int, action: Callable[[], None]) -> None:
    """Do something just before an exposure."""
    count = 0
    for camera in emulated.bench.cameras:
        expose = camera.expose

        def counted(expose: Callable[[], object] = expose) -> object:
            nonlocal count
            count += 1
            if count == number:
                action()
            return expose()

        camera.expose = counted  # type: ignore[method-assign,assignment]


def reset(emulated: Emulation) -> None:
    """The board forgets its lines and its mirrors, and listens again at once."""
    emulated.bench.board.set_pattern(0)
    for galvo in emulated.bench.board.galvos:
        galvo.aim(0, emulated.clock.now())


def at_message(emulated: Emulation, wanted: Callable[[bytes, int], bool], action: Callable[[], None]) -> None:
    """Do something, and lose the message, when the board is sent a certain one."""
    line, number = emulated.lines["board"], 0
    receive = line.receive

    def received(data: bytes) -> None:
        nonlocal number
        number += data[:1] == b"\x03"  # mirrors: two messages an aim
        if wanted(data, number):
            wanted_once.append(True)
            if len(wanted_once) == 1:
                action()
                return
        receive(data)

    wanted_once: list[bool] = []
    line.receive = received  # type: ignore[method-assign]


def test_a_board_that_was_reset_never_gives_an_image(tmp_path: Path) -> None:
    """It forgets gates and mirrors. In an exposure, in the floodlight, and after the mirrors have been aimed."""
    whole = tmp_path / "whole"
    capture(TwinRig(RIG, Glow(), seed=5), PLAN, whole)
    for number, when in enumerate(("exposure", "floodlight", "aimed")):
        emulated, parts = emulation(), tmp_path / when
        if when == "aimed":  # the lines are read (2) before the gate opens for the second spot
            at_message(emulated, lambda data, n: n == 6 and data[:1] == b"\x02", lambda e=emulated: reset(e))  # type: ignore[misc]
        else:
            at_image(emulated, 1 if when == "floodlight" else 4, emulated.lines["board"].power_cycle)
        with pytest.raises(DiscoError, match="Remedy"):
            capture(emulated.serial_rig(), PLAN, parts)
        assert emulated.bench.light() == [] and not any(h.on_since for h in emulated.bench.heads)
        assert capture(emulation().serial_rig(), PLAN, parts).resumed_at == (3, 0, 4)[number]
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
    emulated.lines["board"].answer_faults.extend([lambda data: []] * 99)
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
    for line in emulated.lines.values():
        line.receive = said.append  # type: ignore[method-assign]
    model = emulated.serial_rig()
    if make == "serial":
        rig = SerialRig(model._connect, emulated.wiring(), emulated.bench.cameras, emulated.clock, armed=False)
        with pytest.raises(Refused, match=r"not armed.*Remedy.*--arm"):
            capture(rig, PLAN, tmp_path)
        assert said == [] and not rig.connected
        return
    (tmp_path / "rig.toml").write_text(text(laser1="/dev/ttyNOBODY"))
    file = load_rig_file(tmp_path / "rig.toml")
    with assembled(file, RIG, TwinRig(RIG, Glow(), seed=5), armed=False) as rig, pytest.raises(Refused, match="--arm"):
        rig.__enter__()
    with (
        assembled(file, RIG, TwinRig(RIG, Glow(), seed=5), armed=True) as rig,
        pytest.raises(Unplugged, match="NOBODY"),
    ):
        rig.__enter__()


# ---- the lasers' own readings, before every view


def test_lasers_are_read_before_every_view_and_written_down(tmp_path: Path) -> None:
    emulated = emulation()
    capture(emulated.serial_rig(), PLAN, tmp_path)
    rows = read_lasers(tmp_path)
    assert [(row.view, row.laser) for row in rows] == [(view, k) for view in range(PLAN.views) for k in range(3)]
    assert all(row.set_w == 0.01 and row.own_w == pytest.approx(0.01) and row.dark_w == 0.0 for row in rows)
    assert drifts(rows) == dict.fromkeys(range(PLAN.views), 0.0)


def weaken(emulated: Emulation, laser: int, share: float) -> None:
    """The head gives less than it is set to; what comes through its gate does not change (its reading is asked for)."""
    firmware = emulated.lines[f"laser{laser}"].firmware
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
        emulated.lines["laser0"].answer_faults.append(lambda data: [(0.0, data.replace(b"10.", b"70."))])
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
        assert [reading.dark_w for reading in rig.check()] == [8 * w.watts_per_count for w in emulated.wiring()]
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


def test_the_photodiode_is_compared_with_the_set_point() -> None:
    emulated = emulation()
    with emulated.serial_rig() as rig, gate_open(rig.lasers[0]):
        rig.cameras[0].expose()
        emulated.bench.heads[0].set_interlock(closed=False)
        with pytest.raises(DeviceFault, match=r"gives 0.00 mW at the photodiode instead of 10 mW"):
            rig.photodiode.read()


# ---- the commands


def text(scene: RigConfig = RIG, **ports: str) -> str:
    return rig_file_of(scene, ports)


SCENE = """
format_version = 1
name = "bench"
[object.shape]
kind = "sphere"
radius_mm = 15.0
[object.medium.base]
kind = "homogeneous"
sigma_t_per_mm = 1.3
albedo = [0.99, 0.99, 0.99]
[rig]
spots = 6
turntable_angles_deg = [0.0]
[[rig.cameras]]
name = "front"
position_mm = [450.0, 60.0, 100.0]
width = 48
height = 31
pixel_pitch_um = 176.0
[[relight.views]]
name = "left"
position_mm = [150.0, 400.0, 110.0]
[[relight.views]]
name = "right"
position_mm = [-375.0, -190.0, 95.0]
"""


def test_real_lasers_are_armed_explicitly(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, rig = tmp_path / "scene.toml", tmp_path / "rig.toml"
    scene.write_text(SCENE)
    config = RigConfig(cameras=(RIG.cameras[0],))
    rig.write_text(rig_file_of(config, {"laser1": "/dev/ttyUSB7"}))
    with pytest.raises(SystemExit) as end:
        main(["capture", str(scene), "--out", str(tmp_path / "out"), "--rig", str(rig)])
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert "real lasers will emit (/dev/ttyUSB7)" in said and "--arm" in said and said.count("\n") == 1


def test_probe_and_selftest_of_served_devices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("disco_twin.firmware.omicron.EMISSION_S", 0.05)
    monkeypatch.setattr("disco_twin.firmware.turning.SPEED_DEG_S", 720.0)
    monkeypatch.setattr("hw.devices.mm_ard.BOOT_S", 0.05)
    with served(RIG, 3, tmp_path / "ports") as path:
        with pytest.raises(SystemExit) as end:
            main(["rig", "probe", str(path), "--logs", str(tmp_path / "logs")])
        said = capsys.readouterr().out
        assert end.value.code == 0 and said.count("ok  ") == 5 and "LuxX 532 nm, 10 mW" in said, said
        assert len(list((tmp_path / "logs").iterdir())) == 5
        findings = list(selftest(load_rig_file(path), None, armed=True))
        assert all(f.good for f in findings) and len(findings) == 10
        names = [f.name for f in findings]  # no gate is opened before every laser has said that it is off
        assert names.index("gates") == 1 + max(i for i, name in enumerate(names) if name.endswith(", off"))
        assert sum("own reading 10.00 mW, photodiode 10.0" in f.text for f in findings) == 3
        board = Path(path.parent, "board")
        file = path.read_text().replace(f'"{board}"', f'"{path.parent / "laser0"}"').replace("laser0", "laser9", 1)
        (tmp_path / "wrong.toml").write_text(file)
        with pytest.raises(SystemExit) as end:
            main(["rig", "probe", str(tmp_path / "wrong.toml")])
        said = capsys.readouterr().out
        assert end.value.code == 1
        assert said.count("FAIL") == 2 and "is not an MM-Ard board" in said and "laser9" in said
        assert "Traceback" not in said and said.count("Remedy") == 2


def test_ctrl_c_in_a_selftest_does_not_go_on_to_the_next_laser(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The guard closes its port at the signal, so that closing the laser fails."""
    monkeypatch.setattr("hw.devices.mm_ard.BOOT_S", 0.05)
    tried = []

    class Head:
        def measured_mw(self) -> float:
            return 0.0

        def arm(self, power_mw: float) -> None:
            tried.append(power_mw)

        def emit(self) -> None:
            raise KeyboardInterrupt

        def close(self) -> None:
            raise SwitchedOff("guard://laser0", "the port of the laser", "is closed", "none")

    monkeypatch.setattr("disco_twin.assembly.Connector.omicron", lambda self, index: Head())
    with served(RIG, 3, tmp_path / "ports") as path:
        findings = selftest(load_rig_file(path), None, armed=True)
        with pytest.raises(KeyboardInterrupt):
            list(findings)
    assert tried == [10.0]


def test_no_gate_is_tested_where_a_laser_may_be_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hw.devices.mm_ard.BOOT_S", 0.05)

    def unreachable(self: object, index: int) -> object:
        raise SwitchedOff("laser", "the laser", "does not answer", "none")

    monkeypatch.setattr("disco_twin.assembly.Connector.omicron", unreachable)
    with served(RIG, 3, tmp_path / "ports") as path:
        findings = {f.name: f for f in selftest(load_rig_file(path), None, armed=False)}
    assert not findings["gates"].good and "left shut" in findings["gates"].text


def test_nothing_real_is_said_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.toml").write_text(text())
    with pytest.raises(SystemExit) as end:
        main(["rig", "probe", str(tmp_path / "rig.toml")])
    assert end.value.code == 0 and "nothing to connect to" in capsys.readouterr().out.replace("\n", "")


def test_devices_capture_into_a_run_folder_and_nothing_simulates_over_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`capture --rig` with everything emulated, the light being a stand-in; then the twin leaves the folder alone."""
    scene, rig, out = tmp_path / "scene.toml", tmp_path / "rig.toml", tmp_path / "out"
    scene.write_text(SCENE)
    rig.write_text(rig_file_of(RigConfig(cameras=(RIG.cameras[0],)), {}))
    monkeypatch.setattr("disco_twin.simulate.twin_rig", lambda world, folder: TwinRig(world.scene.rig, Glow(), 5))

    def command(*words: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as end:
            main([*words])
        captured = capsys.readouterr()
        return int(end.value.code or 0), captured.out + captured.err

    status, said = command("capture", str(scene), "--out", str(out), "--rig", str(rig))
    assert status == 0, said
    images = (out / "capture" / "images.bin").read_bytes()
    monkeypatch.setattr("disco_twin.run.light_key", lambda run: "changed code")
    assert command("capture", str(scene), "--out", str(out))[0] == 0
    assert (out / "capture" / "images.bin").read_bytes() == images
    changed = rig.read_text().replace("zero_deg", "# zero_deg").replace("[turntable]", "[turntable]\nzero_deg = 5.0")
    rig.write_text(changed)
    status, said = command("capture", str(scene), "--out", str(out), "--rig", str(rig))
    assert status == 2 and said.count("\n") == 1
    assert "rig.toml: turntable.zero_deg = 5.0: the capture in this folder was begun with 0.0. Remedy: " in said
    assert "zero_deg" not in (out / "capture" / "devices.toml").read_text()  # what it was begun with is kept
    assert len(read_lasers(out / "capture")) == 3
    status, said = command("quality", str(out / "capture"))
    assert status == 0 and "19/19" in said


# ---- a board that falls silent while a gate is open


@pytest.mark.parametrize("deaf", [False, True])
def test_light_is_gone_at_once_when_an_image_fails_before_a_silent_board(deaf: bool) -> None:
    """Mute: it hears and does not answer; deaf: it does not even hear. The lasers must not wait for it."""
    emulated = emulation()
    with pytest.raises(DiscoError), emulated.serial_rig() as rig, gate_open(rig.lasers[0]):  # noqa: PT012 - a gate block
        assert emulated.bench.light() == [0]
        line = emulated.lines["board"]
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
    emulated = emulation()
    with pytest.raises(DeviceFault), emulated.serial_rig() as rig, gate_open(rig.lasers[0]):  # noqa: PT012 - a gate block
        emulated.lines["board"].command_faults.append(lambda data: b"")
        begun = emulated.clock.now()
        dark = []
        receive = emulated.lines["laser0"].receive

        def told(data: bytes) -> None:
            receive(data)
            if b"LOf" in data:
                dark.append(emulated.clock.now())

        emulated.lines["laser0"].receive = told  # type: ignore[method-assign]
        rig.photodiode.read()
    assert dark[0] - begun < 0.3  # the 0.2 s after which an answer counts as lost, and no repetition


def test_an_opening_whose_answer_was_lost_is_not_repeated_before_aiming_anew() -> None:
    emulated = emulation()
    sent: list[bytes] = []
    with emulated.serial_rig() as rig:
        rig.projector.move(100, 200)
        line = emulated.lines["board"]
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


def test_no_gate_opens_before_the_rig_is_entered_anew_when_the_light_was_cut() -> None:
    """The lasers were told off: their gates would let out nothing, or what a laser that did not hear still emits."""
    emulated = emulation()
    with emulated.serial_rig() as rig:
        rig.cut()
        with pytest.raises(
            DeviceFault, match=r"lost an answer while a gate was open: the lasers were switched off.*Remedy"
        ):
            rig.lasers[0].open_gate()
        assert not emulated.bench.board.lines & 7
    with rig, gate_open(rig.lasers[0]):
        assert emulated.bench.light() == [0]


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
    rig.devices().board.shut_now = full  # type: ignore[method-assign]
    rig.make_safe()
    assert not any(head.on_since for head in emulated.bench.heads)


def test_a_rig_file_is_corrected_before_the_first_image_and_the_pipeline_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first attempt finds no board, and takes no image: what it left may not outlive the correction."""
    scene, rig, out = tmp_path / "scene.toml", tmp_path / "rig.toml", tmp_path / "out"
    scene.write_text(SCENE)
    rig.write_text(rig_file_of(RigConfig(cameras=(RIG.cameras[0],)), {"board": "/dev/ttyNOBODY"}))
    monkeypatch.setattr("disco_twin.simulate.twin_rig", lambda world, folder: TwinRig(world.scene.rig, Glow(), 5))
    for port, status in (("/dev/ttyNOBODY", 2), ("emulated", 0)):
        rig.write_text(rig_file_of(RigConfig(cameras=(RIG.cameras[0],)), {"board": port}))
        with pytest.raises(SystemExit) as end:
            main(["capture", str(scene), "--out", str(out), "--rig", str(rig)])
        assert end.value.code == status, capsys.readouterr().err
        assert f'port = "{port}"' in (out / "capture" / "devices.toml").read_text()
