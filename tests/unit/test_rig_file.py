"""The rig file: what it refuses, and rigs of every mixture that give the direct twin's capture byte for byte."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from capture_fakes import contents
from test_capture_twin import PLAN, RIG, Glow

from disco_twin.assembly import assembled
from disco_twin.firmware.emulate import Emulation
from disco_twin.firmware.serve import Server
from disco_twin.rig import TwinRig
from disco_twin.rig_commands import emulated_devices, rig_file_of
from disco_twin.rig_file import DevicesFile, load_rig_file, require_scene
from hw.errors import DeviceFault, InputError
from pipeline.capture.loop import capture
from pipeline.capture.stream import StreamReader
from pipeline.rig import LaserConfig, SensorConfig

FAST = RIG.model_copy(update={"sensor": SensorConfig(longest_exposure_s=1e-3)})


def text(**ports: str) -> str:
    """The rig file of an emulated rig; `ports` puts real ones in."""
    return rig_file_of(RIG, ports)


def rig_file(tmp_path: Path, content: str) -> DevicesFile:
    path = tmp_path / "rig.toml"
    path.write_text(content)
    return load_rig_file(path)


@pytest.fixture(scope="module")
def direct(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("direct")
    capture(TwinRig(FAST, Glow(), seed=5), PLAN, folder)
    return folder


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("gate_line = 1", "gate_line = 0"), "distinct TTL lines"),
        (("floodlight_line = 5", "floodlight_line = 2"), "distinct TTL lines"),
        (("power_mw = 10", "power_mw = 600"), r"lasers\[0\].power_mw = 600.*<= 500"),
        (('kind = "zaber"', 'kind = "zabar"'), "did you mean 'zaber'"),
        (("microsteps_per_deg", "microstep_per_deg"), "did you mean 'microsteps_per_deg'"),
        (('port = "emulated"\nfloodlight', 'port = "/dev/a"\nlimits_u = [0, 5000]\nfloodlight'), r"limits_u\[1\]"),
        (
            ('[turntable]\nkind = "zaber"\nport = "emulated"', '[turntable]\nkind = "zaber"\nport = ""'),
            "turntable.port",
        ),
        (('kind = "simulated"', 'kind = "genicam"\naddress = "10.0.0.9"'), "all of the kind genicam or all simulated"),
        (("[0.1, 1.5]", "[1.1, 1.5]"), "must enclose 1"),
        (("watts_per_count = ", "watts_per_count = 1e-9 #"), "converter ends below power_mw"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(tmp_path: Path, change: tuple[str, str], says: str) -> None:
    assert change[0] in text()
    with pytest.raises(InputError, match=says) as caught:
        rig_file(tmp_path, text().replace(*change, 1))
    assert "rig.toml" in str(caught.value) and "\n" not in str(caught.value)


def test_two_devices_on_one_port_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="share a port: /dev/ttyUSB0"):
        rig_file(tmp_path, text(board="/dev/ttyUSB0", turntable="/dev/ttyUSB0"))


def test_another_rig_s_scene_is_refused(tmp_path: Path) -> None:
    file = rig_file(tmp_path, text())
    require_scene(file, RIG, tmp_path / "rig.toml")
    for change, says in (
        ({"lasers": RIG.lasers[:2]}, "other lasers"),
        ({"lasers": (LaserConfig(wavelength_nm=650), *RIG.lasers[1:])}, r"lasers\[0\].wavelength_nm"),
        ({"cameras": RIG.cameras[::-1]}, "other cameras"),
    ):
        with pytest.raises(InputError, match=says):
            require_scene(file, RIG.model_copy(update=change), tmp_path / "rig.toml")


def test_the_emulated_rig_equals_the_direct_twin(tmp_path: Path, direct: Path) -> None:
    with assembled(rig_file(tmp_path, text()), FAST, TwinRig(FAST, Glow(), seed=5)) as rig:
        capture(rig, PLAN, tmp_path / "serial")
    assert contents(tmp_path / "serial") == contents(direct)


@pytest.fixture
def devices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Emulation, dict[str, str]]]:
    """Devices that are real as far as the rig knows: on pseudo-terminals, in real time, behind a guard."""
    monkeypatch.setattr("disco_twin.firmware.omicron.EMISSION_S", 0.05)  # nothing is learnt from waiting
    monkeypatch.setattr("disco_twin.firmware.turning.SPEED_DEG_S", 720.0)
    (tmp_path / "ports").mkdir()
    emulation = emulated_devices(FAST, seed=9)
    with Server(emulation.lines, tmp_path / "ports") as server:
        yield emulation, server.urls


@pytest.mark.parametrize("real", [["turntable"], ["turntable", "board", "laser0", "laser1", "laser2"]])
def test_simulated_cameras_see_what_real_devices_do(
    tmp_path: Path, direct: Path, real: list[str], devices: tuple[Emulation, dict[str, str]]
) -> None:
    """A real turntable with simulated cameras: the same bytes. Everything real but the cameras: the same light, too."""
    emulation, urls = devices
    file = rig_file(tmp_path, text(**{name: urls[name] for name in real}))
    with assembled(file, FAST, TwinRig(FAST, Glow(), seed=5)) as rig:
        capture(rig, PLAN, tmp_path / "mixed")
    with StreamReader(tmp_path / "mixed") as mixed, StreamReader(direct) as whole:
        for index in range(len(PLAN)):
            a, b = mixed.read(index), whole.read(index)
            assert np.array_equal(a.charge, b.charge) and np.array_equal(a.exponent, b.exponent)
            assert real != ["turntable"] or mixed.meta(index) == whole.meta(index)
    assert abs(emulation.bench.spindle.position(emulation.clock.now()) - 180) < 0.01
    assert emulation.bench.hazards == [] and emulation.bench.light() == []
    assert all(head.on_since is None for head in emulation.bench.heads)


def test_limits_zero_and_direction(tmp_path: Path) -> None:
    content = text().replace("floodlight_line = 5", "floodlight_line = 5\nlimits_u = [1000, 3000]")
    content = content.replace("[turntable]", "[turntable]\nzero_deg = 30\ndirection = -1")
    twin = TwinRig(RIG, Glow(), seed=5)
    with assembled(rig_file(tmp_path, content), RIG, twin) as rig, rig:
        with pytest.raises(InputError, match=r"board.limits_u = 3001: .*1000 to 3000.*Remedy"):
            rig.projector.move(3001, 2000)
        rig.turntable.move(np.deg2rad(50))
        assert rig.devices().table.angle_rad() == pytest.approx(np.deg2rad(50), abs=1e-4)


def test_a_laser_that_is_too_weak_is_refused(tmp_path: Path) -> None:
    with assembled(rig_file(tmp_path, text()), RIG, twin := TwinRig(RIG, Glow(), seed=5)) as rig:
        heads = rig._connect.__self__.emulation.bench.heads  # type: ignore[attr-defined]
        type(heads[1]).emission, before = (lambda self, now: 0.8 * self.level), type(heads[1]).emission
        try:
            with pytest.raises(DeviceFault, match=r"laser 635 nm emits 8.00 mW instead of 10 mW \(allowed: 10 % off\)"):
                rig.__enter__()
        finally:
            type(heads[1]).emission = before
    assert twin is not None
