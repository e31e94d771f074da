"""`disco-twin rig` and `capture --rig`: what they refuse, what they leave behind."""

from __future__ import annotations

from pathlib import Path

import pytest
from test_capture_twin import RIG, Glow

from disco_twin.cli import main
from disco_twin.rig import TwinRig
from disco_twin.rig_commands import emulated_devices, rig_file_of, selftest, served
from disco_twin.rig_rules import load_rig_file
from hw.errors import SwitchedOff
from pipeline.capture.lasers import read_lasers
from pipeline.rig import RigConfig


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
    devices = [emulated_devices(RIG, 3)]
    monkeypatch.setattr("disco_twin.rig_commands.emulated_devices", lambda scene, seed: devices[0])
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
    rig.write_text(rig_file_of(RigConfig(cameras=(RIG.cameras[0],)), {"board": "/dev/ttyNOBODY"}))
    monkeypatch.setattr("disco_twin.simulate.twin_rig", lambda world, folder: TwinRig(world.scene.rig, Glow(), 5))
    for port, status in (("/dev/ttyNOBODY", 2), ("emulated", 0)):
        rig.write_text(rig_file_of(RigConfig(cameras=(RIG.cameras[0],)), {"board": port}))
        with pytest.raises(SystemExit) as end:
            main(["capture", str(scene), "--out", str(out), "--rig", str(rig)])
        assert end.value.code == status, capsys.readouterr().err
        assert f'port = "{port}"' in (out / "capture" / "devices.toml").read_text()
