"""The rig file: what it refuses, and rigs of every mixture that give the direct twin's capture byte for byte."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from capture_fakes import contents
from rig_files import CAMERAS
from serial_fakes import PatientClock
from twin_fakes import PLAN, RIG, Glow

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.emulation.emulated_rig import Emulation, open_scene_rig
from disco_twin.emulation.rig_file_of import rig_file_of
from disco_twin.emulation.serve import Server
from disco_twin.emulation.served_rig import emulated_devices
from disco_twin.emulation.twin_rig import TwinRig
from hw.base.errors import DeviceFault, InputError
from hw.rig.rig_file import DevicesFile
from hw.rig.rig_rules import load_rig_file
from pipeline.capture.loop import Interrupted, capture
from pipeline.capture.rig_fits_scene import require_same, require_scene
from pipeline.capture.unmoved import RigMoved
from pipeline.geometry.nominal_rig import LaserConfig, SensorConfig
from pipeline.stream.stream import StreamReader

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
        (("power_mw = 10", "power_mw = 600"), r"lasers\[0\].power_mw = 600.*<= 500"),
        (("microsteps_per_deg = ", "microsteps_per_deg = 1e308 #"), r"turntable.microsteps_per_deg = 1e\+308.*1000000"),
        (('port = "emulated"', r'port = "/dev/tty\u0000x"'), r"lasers\[0\].port"),
        (('kind = "zaber"', 'kind = "zabar"'), "did you mean 'zaber'"),
        (("microsteps_per_deg", "microstep_per_deg"), "did you mean 'microsteps_per_deg'"),
        (("floodlight_line", "limits_u = [0, 5000]\nfloodlight_line"), r"limits_u\[1\]"),
        (
            ('[turntable]\nkind = "zaber"\nport = "emulated"', '[turntable]\nkind = "zaber"\nport = ""'),
            "turntable.port",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(tmp_path: Path, change: tuple[str, str], says: str) -> None:
    assert change[0] in text()
    with pytest.raises(InputError, match=says) as caught:
        rig_file(tmp_path, text().replace(*change, 1))
    assert "rig.toml" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="there resolve takes it as it is, and opening it fails")
def test_a_port_that_is_a_link_to_itself_is_refused_in_one_line(tmp_path: Path) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    with pytest.raises(InputError, match=r"rig.toml: lasers\[0\].port = .*leads nowhere") as caught:
        rig_file(tmp_path, text(laser0=str(loop)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "key", "value", "allowed"),
    [
        (("gate_line = 1", "gate_line = 0"), "lasers[1].gate_line", "0", "free: 1, 3, 4"),
        (("floodlight_line = 5", "floodlight_line = 2"), "board.floodlight_line", "2", "free: 3, 4, 5"),
        (("photodiode_pin = 2", "photodiode_pin = 1"), "lasers[2].photodiode_pin", "1", "free: 2, 3, 4, 5"),
        (("[0.1, 1.5]", "[1.1, 1.5]"), "lasers[0].photodiode_limits", "[1.1, 1.5]", "lower < 1 < upper"),
        (("[0.1, 1.5]", "[0.5, 1.0]"), "lasers[0].photodiode_limits", "[0.5, 1.0]", "lower < 1 < upper"),
        (
            ("watts_per_count = ", "watts_per_count = 1e-9 #"),
            "lasers[0].power_mw",
            "10.0",
            "at least 9.775e-06",
        ),
        (("floodlight_line", "limits_u = [9, 9]\nfloodlight_line"), "board.limits_u", "[9, 9]", "lower < upper"),
        (("floodlight_line", "limits_v = [3000, 100]\nfloodlight_line"), "board.limits_v", "[3000, 100]", "lower"),
        (("floodlight_line", "limits_u = [2049, 4000]\nfloodlight_line"), "board.centre[0]", "2048", "2049 to 4000"),
        (
            ("floodlight_line", "centre = [2048, 4095]\nlimits_v = [0, 4094]\nfloodlight_line"),
            "board.centre[1]",
            "4095",
            "0 to 4094",
        ),
        (
            ('kind = "simulated"', 'kind = "genicam"\naddress = "10.0.0.9"'),
            "cameras[1].kind",
            "'simulated'",
            "all genicam",
        ),
        (('name = "back"', 'name = "front"'), "cameras[1].name", "'front'", "the scene's cameras"),
        (("[0.1, 1.5]", "[0.007, 1.5]"), "lasers[0].photodiode_limits", "[0.007, 1.5]", "lower > 0.0078"),
        (
            ('"10.0.0.9"', '"10.0.0.9"\npixel_format = "Mono10"'),
            "cameras[0].pixel_format",
            "'Mono10'",
            "Mono12 or deeper",
        ),
        (("10.0.0.8", "10.0.0.9"), "cameras[1].address", "'10.0.0.9'", "one camera an address"),
        (("1e12, 1e12, 1e12", "1e12, 1e12"), "sensor.responsivity", "[1000000000000.0, 1000000000000.0]", "3 values"),
        (("[0, 2, 4]", "[0, 4, 2]"), "sensor.exponents", "[0, 4, 2]", "ascending from 0"),
        (("= 3900", "= 4096"), "sensor.saturation_dn", "4096", "1 to 4095"),
        (("black_dn = 64.0", "black_dn = 3900.0"), "sensor.black_dn", "3900.0", "below saturation_dn = 3900"),
    ],
)
def test_impossible_rigs_name_file_key_value_range_and_remedy(
    tmp_path: Path, change: tuple[str, str], key: str, value: str, allowed: str
) -> None:
    content = text()
    if change[0] not in content or change[0].startswith("10.0"):
        content = content[: content.index("[[cameras]]")] + CAMERAS
    rig_file(tmp_path, content)
    with pytest.raises(InputError) as caught:
        rig_file(tmp_path, content.replace(*change, 1))
    said = str(caught.value)
    assert said.startswith(f"{tmp_path / 'rig.toml'}: {key} = {value}: ") and "\n" not in said
    assert re.search(rf"\(allowed: [^)]*{re.escape(allowed)}", said) and ". Remedy: " in said


def test_real_cameras_need_a_sensor(tmp_path: Path) -> None:
    content = text()[: text().index("[[cameras]]")] + CAMERAS[: CAMERAS.index("[sensor]")]
    with pytest.raises(InputError, match=r"rig\.toml: sensor: required table is missing.*Remedy"):
        rig_file(tmp_path, content)


def test_two_devices_on_one_port_are_refused_whatever_its_name(tmp_path: Path) -> None:
    (tmp_path / "by-id").symlink_to("/dev/ttyUSB0")
    for other in ("/dev/ttyUSB0", str(tmp_path / "by-id")):
        with pytest.raises(InputError, match=rf"turntable.port = '{other}': is the port of board.port as well.*Remedy"):
            rig_file(tmp_path, text(board="/dev/ttyUSB0", turntable=other))


# ---- another rig than the one that began a capture


@pytest.mark.parametrize(
    ("change", "key", "now", "then"),
    [
        (("gate_line = 1", "gate_line = 4"), "lasers[1].gate_line", "4", "1"),
        (("power_mw = 10.0", "power_mw = 9.0"), "lasers[0].power_mw", "9.0", "10.0"),
        (
            ("floodlight_line = 5", "floodlight_line = 5\nlimits_u = [0, 4000]"),
            "board.limits_u",
            "[0, 4000]",
            "[0, 4095]",
        ),
        (("[turntable]", "[turntable]\nzero_deg = 1.5"), "turntable.zero_deg", "1.5", "0.0"),
        (("[turntable]", "[turntable]\ndirection = -1"), "turntable.direction", "-1", "1"),
        (
            ('kind = "mm-ard"\nport = "emulated"', 'kind = "mm-ard"\nport = "/dev/b"'),
            "board.port",
            "'/dev/b'",
            "'emulated'",
        ),
        (("black_dn = 64.0", "black_dn = 65.0"), "sensor.black_dn", "65.0", "64.0"),
        (("gain_e_per_dn = 2.0", "gain_e_per_dn = 2.5"), "sensor.gain_e_per_dn", "2.5", "2.0"),
        (('"10.0.0.9"', '"10.0.0.7"'), "cameras[0].address", "'10.0.0.7'", "'10.0.0.9'"),
        (('"10.0.0.9"', '"10.0.0.9"\nserial = "A"'), "cameras[0].serial", "'A'", "none"),
    ],
)
def test_a_changed_rig_does_not_continue_a_capture(
    tmp_path: Path, change: tuple[str, str], key: str, now: str, then: str
) -> None:
    content = text() if change[0] in text() else text()[: text().index("[[cameras]]")] + CAMERAS
    path = tmp_path / "rig.toml"
    begun, changed = rig_file(tmp_path, content), rig_file(tmp_path, content.replace(*change, 1))
    with pytest.raises(InputError) as caught:
        require_same(changed, begun, path)
    said = str(caught.value)
    assert said == (
        f"{path}: {key} = {now}: the capture in this folder was begun with {then}. "
        "Remedy: set it back, or choose another --out"
    )


@pytest.mark.parametrize(
    "change",
    [
        ('port = "/dev/a"', 'port = "/dev/b"'),
        ("warm_up_s = 0.0", "warm_up_s = 60.0"),
        ("[0.1, 1.5]", "[0.5, 1.4]"),
        ("[turntable]", "[turntable]\nreach_s = 30.0"),
        ("[board]", '[power_meter]\nkind = "ophir"\nport = "/dev/m"\n[board]'),
        ('"10.0.0.9"\nserial = "A"', '"10.0.0.7"\nserial = "A"'),
    ],
)
def test_what_no_image_depends_on_may_change(tmp_path: Path, change: tuple[str, str]) -> None:
    """A device in another socket, a longer patience, stricter limits."""
    content = text(turntable="/dev/a")
    content = content[: content.index("[[cameras]]")] + CAMERAS.replace('"10.0.0.9"', '"10.0.0.9"\nserial = "A"')
    assert change[0] in content
    require_same(rig_file(tmp_path, content.replace(*change, 1)), rig_file(tmp_path, content), tmp_path / "rig.toml")


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
    with open_scene_rig(rig_file(tmp_path, text()), FAST, TwinRig(FAST, Glow(), seed=5), armed=True) as rig:
        capture(rig, PLAN, tmp_path / "serial")
    assert contents(tmp_path / "serial") == contents(direct)


@pytest.fixture
def devices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Emulation, dict[str, str]]]:
    """Devices that are real as far as the rig knows: on pseudo-terminals, behind a supervisor, on one clock with it."""
    clock = PatientClock()
    for module in ("served_rig", "emulated_rig"):
        monkeypatch.setattr(f"disco_twin.emulation.{module}.WallClock", lambda: clock)
    (tmp_path / "ports").mkdir()
    emulation = emulated_devices(FAST, seed=9)
    with Server(emulation.cables, tmp_path / "ports") as server:
        yield emulation, server.urls


@pytest.mark.parametrize("real", [["turntable"], ["turntable", "board", "laser0", "laser1", "laser2"]])
def test_simulated_cameras_see_what_real_devices_do(
    tmp_path: Path, direct: Path, real: list[str], devices: tuple[Emulation, dict[str, str]]
) -> None:
    """A real turntable with simulated cameras: the same bytes. Everything real but the cameras: the same light, too."""
    emulation, urls = devices
    file = rig_file(tmp_path, text(**{name: urls[name] for name in real}))
    with open_scene_rig(file, FAST, TwinRig(FAST, Glow(), seed=5), armed=True) as rig:
        capture(rig, PLAN, tmp_path / "mixed")
    with StreamReader(tmp_path / "mixed") as mixed, StreamReader(direct) as whole:
        for index in range(len(PLAN)):
            a, b = mixed.read(index), whole.read(index)
            assert np.array_equal(a.charge, b.charge) and np.array_equal(a.exponent, b.exponent)
            assert real != ["turntable"] or mixed.meta(index) == whole.meta(index)
    assert abs(emulation.bench.spindle.position(emulation.clock.now()) - 180) < 0.01
    assert emulation.bench.hazards == [] and emulation.bench.light() == []
    assert all(head.on_since is None for head in emulation.bench.heads)


def test_a_mixed_rig_shoots_its_reference_again(
    tmp_path: Path, devices: tuple[Emulation, dict[str, str]], caplog: pytest.LogCaptureFixture
) -> None:
    """Rationale: cameras are simulated, lasers, gates and photodiode are not: light that has changed must be refused.

    Expected: resumed with the reference compared; with a third less light behind the gate refused with the figures.
    """
    emulation, urls = devices
    file, sensor = rig_file(tmp_path, text(**urls)), lars3_sensor(FAST)
    out = tmp_path / "mixed"

    def attempt(stop_at: int) -> None:
        def progress(done: int, total: int) -> None:
            if done == stop_at:
                raise KeyboardInterrupt

        with open_scene_rig(file, FAST, TwinRig(FAST, Glow(), seed=5), armed=True) as rig:
            capture(rig, PLAN, out, progress, sensor)

    with pytest.raises(Interrupted):
        attempt(3)
    caplog.set_level("INFO")
    with pytest.raises(Interrupted):
        attempt(4)
    assert re.search(r"reference \(view 0, spot 0.*laser power \+0.0 %.*moved by .0.00, .0.00 px", caplog.text)
    sample = emulation.bench.board.sample
    emulation.bench.board.sample = lambda pin: round(0.67 * sample(pin))
    with pytest.raises(RigMoved, match=r"laser power -3[23].\d % \(allowed: 20\).*Remedy"):
        attempt(99)
    assert emulation.bench.hazards == [] and not any(head.on_since for head in emulation.bench.heads)


def test_limits_zero_and_direction(tmp_path: Path) -> None:
    content = text().replace("floodlight_line = 5", "floodlight_line = 5\nlimits_u = [1000, 3000]")
    content = content.replace("[turntable]", "[turntable]\nzero_deg = 30\ndirection = -1")
    twin = TwinRig(RIG, Glow(), seed=5)
    with open_scene_rig(rig_file(tmp_path, content), RIG, twin, armed=True) as rig, rig:
        with pytest.raises(InputError, match=r"board.limits_u = 3001: .*1000 to 3000.*Remedy"):
            rig.projector.move(3001, 2000)
        rig.turntable.move(np.deg2rad(50))
        assert rig.drivers().table.angle_rad() == pytest.approx(np.deg2rad(50), abs=1e-4)


def test_a_laser_that_is_too_weak_is_refused(tmp_path: Path) -> None:
    with open_scene_rig(rig_file(tmp_path, text()), RIG, twin := TwinRig(RIG, Glow(), seed=5), armed=True) as rig:
        heads = rig._connector.stand_ins.subscriber.bench.heads  # type: ignore[attr-defined]
        type(heads[1]).emission, before = (lambda self, now: 0.8 * self.level), type(heads[1]).emission
        try:
            with pytest.raises(DeviceFault, match=r"laser 635 nm emits 8.00 mW instead of 10 mW \(allowed: 10 % off\)"):
                rig.__enter__()
        finally:
            type(heads[1]).emission = before
    assert twin is not None
