"""`disco-twin rig` and `capture --rig`: what they refuse, what they leave behind."""

from __future__ import annotations

from pathlib import Path

import pytest
from rig_fakes import SCENE, quick
from twin_fakes import RIG, Glow

from disco_twin.cli.app import main
from disco_twin.emulation.rig_file_of import rig_file_of
from disco_twin.emulation.served_rig import emulated_devices, served
from disco_twin.emulation.twin_rig import TwinRig
from disco_twin.firmware.omicron import COMMANDS, Command, LaserHead
from disco_twin.scene.rig_schema import TwinRigConfig
from hw.base.errors import SwitchedOff
from hw.devices.omicron_protocol import Mode
from hw.rig.rig_rules import load_rig_file
from hw.rig.selftest import probe, selftest
from pipeline.capture.laser_log import read_lasers


def text(scene: TwinRigConfig = RIG, **ports: str) -> str:
    return rig_file_of(scene, ports)


def test_real_lasers_are_armed_explicitly(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, rig = tmp_path / "scene.toml", tmp_path / "rig.toml"
    scene.write_text(SCENE)
    config = TwinRigConfig(cameras=(RIG.cameras[0],))
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
    devices = [emulated_devices(RIG, 3)]
    monkeypatch.setattr("disco_twin.emulation.served_rig.emulated_devices", lambda scene, seed: devices[0])
    with served(RIG, 3, tmp_path / "ports") as path:
        with pytest.raises(SystemExit) as end:
            main(["rig", "probe", str(path), "--logs", str(tmp_path / "logs")])
        said = capsys.readouterr().out
        assert end.value.code == 0 and said.count("ok  ") == 5 and "LuxX 532 nm, 10 mW" in said, said
        assert len(list((tmp_path / "logs").iterdir())) == 5
        findings = list(selftest(load_rig_file(path), None, armed=True))
        assert all(f.good for f in findings) and len(findings) == 10
        names = [f.name for f in findings]  # no gate is opened before every laser has said that it is off
        assert [name.endswith(", off") for name in names] == [True] * 3 + [False] * 7 and names[3] == "turntable"
        assert sum("own reading 10.00 mW, photodiode 10.0" in f.text for f in findings) == 3
        assert devices[0].bench.hazards == []  # the warning lamp is lit before each of the lasers
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
    """The supervisor closes its port at the signal, so that closing the laser fails."""
    monkeypatch.setattr("hw.devices.mm_ard.BOOT_S", 0.05)
    tried, told = [], []

    class LaserDriver:
        name = "laser 635 nm"

        def require_off(self) -> float:
            return 0.0

        def arm(self, power_mw: float) -> None:
            tried.append(power_mw)

        def emit(self) -> None:
            raise KeyboardInterrupt

        def darken(self) -> None:
            told.append(True)

        def close(self) -> None:
            if tried:
                raise SwitchedOff("supervised://laser:laser0", "the port of the laser", "is closed", "none")

    monkeypatch.setattr("hw.rig.connect.Connector.omicron", lambda self, index: LaserDriver())
    with served(RIG, 3, tmp_path / "ports") as path:
        findings = selftest(load_rig_file(path), None, armed=True)
        with pytest.raises(KeyboardInterrupt):
            list(findings)
    assert tried == [10.0] and told


def test_no_gate_is_tested_where_a_laser_may_be_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hw.devices.mm_ard.BOOT_S", 0.05)

    def unreachable(self: object, index: int) -> object:
        raise SwitchedOff("laser", "the laser", "does not answer", "none")

    monkeypatch.setattr("hw.rig.connect.Connector.omicron", unreachable)
    with served(RIG, 3, tmp_path / "ports") as path:
        findings = {f.name: f for f in selftest(load_rig_file(path), None, armed=False)}
    assert not findings["gates"].good and "left shut" in findings["gates"].text and "turntable" not in findings


def deaf_to(obey: Command, deaf: LaserHead, answer: str) -> Command:
    """This command, which one laser answers without obeying."""
    return lambda head, arguments, now: answer if head is deaf else obey(head, arguments, now)


@pytest.mark.parametrize("command", ["probe", "selftest"])
def test_a_laser_that_says_off_and_emits_is_not_let_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    """Laser 0 answers every command with yes and obeys none."""
    bench = quick(monkeypatch).bench
    deaf = bench.heads[0]
    for letters, answer in (("LOf", ">"), ("TPP", ">"), ("SOM", ">"), ("GOM", "0000")):
        monkeypatch.setitem(COMMANDS, letters, deaf_to(COMMANDS[letters], deaf, answer))
    lines: list[int] = []
    set_pattern = bench.board.set_pattern

    def pattern_set(pattern: int) -> None:
        lines.append(pattern)
        set_pattern(pattern)

    monkeypatch.setattr(bench.board, "set_pattern", pattern_set)
    with served(RIG, 3, tmp_path / "ports") as path:
        deaf.mode, deaf.level, deaf.on_since = int(Mode.BIAS | Mode.RELEASE), 1.0, bench.clock.now() - 60.0
        assert deaf.emission(bench.clock.now()) == 1.0
        file = load_rig_file(path)
        run = probe(file, None) if command == "probe" else selftest(file, None, armed=True)
        findings = {f.name: f for f in run}
    first = findings["laser 635 nm" if command == "probe" else "laser 635 nm, off"]
    assert not first.good and "was told to go off, reports that it is on" in first.text
    assert sum(not f.good for f in findings.values()) == (1 if command == "probe" else 2)
    assert command == "probe" or not findings["gates"].good
    assert not any(pattern & 0b111 for pattern in lines)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("leaks", "reads 500 counts with every gate shut (allowed: 8)"),
        ("saturates", "(1023 counts) at the photodiode instead of 10 mW (the converter is at its top)"),
        ("reset", "it was reset"),
    ],
)
def test_an_armed_selftest_finds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str, says: str) -> None:
    """A gate that lets light through; an amplifier at its end; a board that is reset between lamp and gate."""
    devices = quick(monkeypatch)
    bench = devices.bench
    start = bench.heads[0].on_start
    lit = bench.board.sample
    gates: list[int] = []
    set_pattern = bench.board.set_pattern

    def leak(pin: int) -> int:
        return 500 if bench.heads[pin].emission(bench.clock.now()) else 0

    def pattern_set(pattern: int) -> None:
        set_pattern(pattern)
        gates.append(pattern & 0b111)

    def reset_at_start() -> None:
        start()
        devices.cables["board"].power_cycle()

    if fault == "leaks":
        monkeypatch.setattr(bench.board, "sample", leak)
    elif fault == "reset":
        monkeypatch.setattr(bench.heads[0], "on_start", reset_at_start)
    elif fault == "saturates":
        monkeypatch.setattr(bench.board, "sample", lambda pin: 1023 if lit(pin) else 0)
    monkeypatch.setattr(bench.board, "set_pattern", pattern_set)
    with served(RIG, 3, tmp_path / "ports") as path:
        path.write_text(path.read_text().replace("[0.1, 1.5]", "[0.1, 9.0]"))
        found = {f.name: f for f in selftest(load_rig_file(path), None, armed=True)}["laser 635 nm"]
    assert not found.good and says in found.text, found
    assert fault == "saturates" or gates[gates.index(0b100) + 1 :].count(0b001) == 0  # after the test of the lines
    assert bench.hazards == [] and bench.light() == []


@pytest.mark.parametrize("command", ["probe", "selftest"])
def test_another_scenes_rig_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    """Its cameras have no size."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "rig.toml").write_text(text().replace('name = "front"', 'name = "top"'))
    with pytest.raises(SystemExit) as end:
        main(["rig", command, str(tmp_path / "rig.toml"), "--scene", str(tmp_path / "scene.toml")])
    said = capsys.readouterr().err
    assert end.value.code == 2 and said.count("\n") == 1 and "the scene has other cameras" in said, said


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
    rig.write_text(rig_file_of(TwinRigConfig(cameras=(RIG.cameras[0],)), {}))
    monkeypatch.setattr("disco_twin.run.simulate.twin_rig", lambda x, _: TwinRig(x.scene.rig, Glow(), 5))

    def command(*words: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as end:
            main([*words])
        captured = capsys.readouterr()
        return int(end.value.code or 0), captured.out + captured.err

    status, said = command("capture", str(scene), "--out", str(out), "--rig", str(rig))
    assert status == 0, said
    images = (out / "capture" / "images.bin").read_bytes()
    monkeypatch.setattr("disco_twin.run.stages.code_key", lambda *_: "changed code")
    assert command("capture", str(scene), "--out", str(out))[0] == 0
    assert (out / "capture" / "images.bin").read_bytes() == images
    begun_with = (out / "capture" / "devices.toml").read_bytes()
    rig.write_text(rig.read_text().replace("warm_up_s = 0.0", "warm_up_s = 1.0"))  # no image depends on it
    assert command("capture", str(scene), "--out", str(out), "--rig", str(rig))[0] == 0
    changed = rig.read_text().replace("zero_deg", "# zero_deg").replace("[turntable]", "[turntable]\nzero_deg = 5.0")
    rig.write_text(changed)
    status, said = command("capture", str(scene), "--out", str(out), "--rig", str(rig))
    assert status == 2 and said.count("\n") == 1
    assert "rig.toml: turntable.zero_deg = 5.0: the capture in this folder was begun with 0.0. Remedy: " in said
    assert (out / "capture" / "devices.toml").read_bytes() == begun_with
    assert len(read_lasers(out / "capture")) == 3
    status, said = command("quality", str(out / "capture"))
    assert status == 0 and "19/19" in said


def test_a_rig_file_is_corrected_before_the_first_image_and_the_pipeline_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first attempt finds no board, and takes no image: what it left may not outlive the correction."""
    scene, rig, out = tmp_path / "scene.toml", tmp_path / "rig.toml", tmp_path / "out"
    scene.write_text(SCENE)
    rig.write_text(rig_file_of(TwinRigConfig(cameras=(RIG.cameras[0],)), {"board": "/dev/ttyNOBODY"}))
    monkeypatch.setattr("disco_twin.run.simulate.twin_rig", lambda x, _: TwinRig(x.scene.rig, Glow(), 5))
    for port, status in (("/dev/ttyNOBODY", 2), ("emulated", 0)):
        rig.write_text(rig_file_of(TwinRigConfig(cameras=(RIG.cameras[0],)), {"board": port}))
        with pytest.raises(SystemExit) as end:
            main(["capture", str(scene), "--out", str(out), "--rig", str(rig)])
        assert end.value.code == status, capsys.readouterr().err
        assert f'port = "{port}"' in (out / "capture" / "devices.toml").read_text()
