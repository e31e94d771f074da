"""A laboratory's day without a renderer: drivers, supervisor, a GigE Vision camera; killed half-way, and resumed."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from blocked_renderer import BLOCK
from damaged_images import damaged_images

from hw.base.clock import WallClock
from hw.serial.link import Link
from pipeline.stream.stream import StreamReader

WIDTH, HEIGHT = 64, 48
SCENE = f"""
format_version = 1
name = "bench"
[object.shape]
kind = "sphere"
radius_mm = 15.0
[object.medium.base]
kind = "homogeneous"
sigma_t_per_mm = 1.3
albedo = [0.99]
[rig]
spots = 30
turntable_angles_deg = [0.0, 90.0]
[[rig.lasers]]
wavelength_nm = 635.0
[[rig.cameras]]
name = "front"
position_mm = [450.0, 60.0, 100.0]
width = {WIDTH}
height = {HEIGHT}
pixel_pitch_um = 120.0
[[relight.views]]
name = "left"
position_mm = [150.0, 400.0, 110.0]
[[relight.views]]
name = "right"
position_mm = [-375.0, -190.0, 95.0]
[[relight.lights]]
kind = "uniform"
colour = [1.0]
"""
CAMERA = """
[[cameras]]
kind = "genicam"
name = "front"
address = "127.0.0.1"
serial = "VIVA-FAKE-001"
pixel_format = "Mono16"

[sensor]
longest_exposure_s = 0.01
exponents = [0, 3]
bits = 16
saturation_dn = 40000
black_dn = 32640.0 # of the fake camera's test pattern
black_tolerance_dn = 600.0
gain_e_per_dn = 1.0
read_noise_e = 300.0 # the pattern moves by a grey level from frame to frame
responsivity = [1e12]
"""


def disco_twin(*words: object) -> subprocess.Popen[str]:
    code = BLOCK + f"from disco_twin.cli.app import main; main({list(map(str, words))!r})"
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen[str], timeout_s: float = 120) -> tuple[int, str]:
    out, err = process.communicate(timeout=timeout_s)
    return process.returncode, out + err


@pytest.fixture
def camera() -> Iterator[Any]:
    testing = pytest.importorskip("viva_genicam.testing", reason="needs the extra genicam")
    with Path(tempfile.gettempdir(), "disco-gvcp-3956.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # GigE Vision has one UDP port: one fake camera per host at a time
        with testing.FakeGigeCamera(WIDTH, HEIGHT, 60, pixel_format="Mono16") as fake:
            yield fake


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Path]:
    """The rig file of devices that another process serves."""
    (tmp_path / "scene.toml").write_text(SCENE)
    ports = tmp_path / "ports"
    server = disco_twin("rig", "emulate", tmp_path / "scene.toml", "--ports", ports, "--seconds", 200)
    try:
        deadline = time.monotonic() + 60
        while not (ports / "rig.toml").exists():
            assert time.monotonic() < deadline and server.poll() is None, finish(server)
            time.sleep(0.05)
        text = (ports / "rig.toml").read_text()
        path = tmp_path / "rig.toml"
        path.write_text(text[: text.index("[[cameras]]")] + CAMERA)
        yield path
    finally:
        server.send_signal(signal.SIGINT)
        status, said = finish(server)
    assert status == 0, said


def emits(rig: Path) -> bool:
    """Ask the laser itself, on its bare port, before anything else is said to it."""
    link = Link(str(rig.parent / "ports" / "laser0"), 500000, "laser", WallClock())
    try:
        link.write(b"?MDP\r")
        time.sleep(0.1)
        answer = link.read(1.0)
        return float(answer.split(b"!MDP")[1].split(b"\r")[0]) > 0
    finally:
        link.close()


def begun(rig: Path, tmp_path: Path) -> subprocess.Popen[str]:
    """A capture that has stored some of its 32 images."""
    scene, out = tmp_path / "scene.toml", tmp_path / "out"
    process = disco_twin("capture", scene, "--out", out, "--rig", rig, "--arm", "--logs", tmp_path / "logs")
    images, deadline = out / "capture" / "images.bin", time.monotonic() + 100
    while not (images.exists() and images.stat().st_size > 5000):
        assert time.monotonic() < deadline and process.poll() is None, finish(process)
        time.sleep(0.01)
    return process


def change(path: Path, old: str, new: str) -> None:
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))


def begin_again(scene: Path, out: Path, rig: Path, before: list[Any]) -> Path:
    """What the fake camera leaves to do: no spot stands out of its wandering pattern, so nothing can be compared."""
    status, said = finish(disco_twin("capture", scene, "--out", out, "--rig", rig, "--arm"))
    assert status == 2 and "no stored spot is bright enough" in said and "Remedy: start a new capture" in said, said
    with StreamReader(out / "capture") as stream:
        assert len(stream) == len(before)
        assert all((stream.read(i).charge == charge).all() for i, charge in enumerate(before))
    again = out.with_name("again")
    status, said = finish(disco_twin("capture", scene, "--out", again, "--rig", rig, "--arm"))
    assert status == 0, said
    assert not emits(rig)
    return again


TOO_NOISY_TO_TELL = ("read_noise_e = 300.0", "read_noise_e = 1e6")  # the fake camera's test pattern wanders


def test_capture_killed_resumed_and_looked_at(rig: Path, camera: Any, tmp_path: Path) -> None:
    """Rationale: what a laboratory does, without a renderer. Expected: no image lost, the laser never left on."""
    scene, out = tmp_path / "scene.toml", tmp_path / "out"
    status, said = finish(disco_twin("rig", "selftest", rig, "--scene", scene))
    assert status == 0 and "0 frames taken again" in said, said
    process = begun(rig, tmp_path)
    os.kill(process.pid, signal.SIGKILL)
    time.sleep(0.3)
    assert not emits(rig)
    assert finish(process)[0] == -signal.SIGKILL
    camera.revoke_control()  # a real camera does so by itself, when the killed program gives no sign of life
    with StreamReader(out / "capture") as stream:
        before = [stream.read(i).charge for i in range(len(stream))]
    assert 0 < len(before) < 32
    status, said = finish(disco_twin("capture", scene, "--out", out, "--rig", rig, "--arm"))
    assert status == 2 and "the rig has changed since image" in said, said  # its test pattern wanders
    change(rig, *TOO_NOISY_TO_TELL)
    status, said = finish(disco_twin("capture", scene, "--out", out, "--rig", rig, "--arm"))
    assert status == 2 and "read_noise_e = 1000000.0: the capture in this folder was begun with 300.0" in said, said
    change(out / "capture" / "devices.toml", *TOO_NOISY_TO_TELL)
    out = begin_again(scene, out, rig, before)
    with StreamReader(out / "capture") as stream:
        stream.require_complete()
        assert damaged_images(stream) == [] and len(stream) == 32
        assert all(abs(stream.meta(i).photodiode_w - 0.01) < 1e-4 for i in range(len(stream)) if i not in (0, 16))
    status, said = finish(disco_twin("quality", out / "capture"))
    assert status == 0 and len([row for row in said.splitlines() if row.split()[1:2] == ["front"]]) == 2, said
    assert "do not show the scan at the stated poses" in said  # the camera's test pattern shows none
    assert (tmp_path / "logs" / "laser0.log").read_text().startswith("disco-twin byte log")
    rows = (out / "capture" / "lasers.csv").read_text().splitlines()
    assert {row.split(",")[0] for row in rows[1:]} == {"0", "1"} and all(",0.01,0.01,0.0" in row for row in rows[1:])


def test_a_supervisor_that_is_killed_in_the_middle_of_a_scan(rig: Path, camera: Any, tmp_path: Path) -> None:
    """Rationale: nobody would switch the laser off then. Expected: dark, one line that says so; nothing lost."""
    scene, out = tmp_path / "scene.toml", tmp_path / "out"
    change(rig, *TOO_NOISY_TO_TELL)
    process = begun(rig, tmp_path)
    listed = ["ps", "-ww", "-o", "pid=,args=", "--ppid", str(process.pid)]
    children = subprocess.run(listed, capture_output=True, text=True, check=True).stdout.splitlines()
    (supervisor,) = [int(line.split()[0]) for line in children if "hw.safety.supervisor" in line]
    os.kill(supervisor, signal.SIGKILL)
    status, said = finish(process)
    assert not emits(rig)
    reason = "its supervisor was killed or stopped (-9); another one makes everything dark"
    assert status == 2 and reason in said and "Remedy: see that every laser is off" in said, said
    assert "Traceback" not in said
    with StreamReader(out / "capture") as stream:
        before = [stream.read(i).charge for i in range(len(stream))]
    assert 0 < len(before) < 32
    out = begin_again(scene, out, rig, before)
    with StreamReader(out / "capture") as stream:
        stream.require_complete()
