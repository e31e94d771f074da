"""The lab page's examples are files that work."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh
from rig_fakes import quick
from rig_files import CAMERAS
from twin_fakes import RIG

from disco_twin.emulation.served_rig import served
from hw.base.config import load_toml
from hw.rig.rig_rules import load_rig_file
from pipeline.capture.import_folder import COLUMNS, CaptureDescription
from pipeline.capture.rig_fits_scene import require_scene
from pipeline.geometry.nominal_rig import CameraConfig, RigConfig


def blocks(repository: Path, language: str) -> list[str]:
    text = (repository / "docs" / "lab.md").read_text(encoding="utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def test_examples(repository: Path, tmp_path: Path) -> None:
    rig, description = blocks(repository, "toml")
    (tmp_path / "rig.toml").write_text(rig)
    file = load_rig_file(tmp_path / "rig.toml")
    assert file.real_lasers and not file.simulated_cameras and not file.all_emulated
    scene = RigConfig(cameras=(CameraConfig(name="front", position_mm=(1, 2, 3)),))
    require_scene(file, scene, tmp_path / "rig.toml")
    trimesh.creation.icosphere().export(tmp_path / "scan.ply")
    (tmp_path / "capture.toml").write_text(description)
    assert load_toml(tmp_path / "capture.toml", CaptureDescription).sensor.steps == 4
    (table,) = blocks(repository, "csv")
    assert table.splitlines()[0] == ",".join(COLUMNS)


def test_commands_exist(repository: Path) -> None:
    from typer.main import get_command

    from disco_twin.cli.app import app

    root = get_command(app)
    seen = set()
    for line in re.findall(r"^disco-twin ([^#\n]+)", "\n".join(blocks(repository, "sh")), flags=re.MULTILINE):
        command, words = root, line.split()
        while hasattr(command, "commands"):
            assert words[0] in command.commands, line
            command = command.commands[words.pop(0)]
        known = {option for parameter in command.params for option in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= known, line
        seen.add(command.name)
    assert seen == {"probe", "selftest", "plan", "capture", "quality", "reconstruct"}


# ---- the script that stands on hw alone

ALONE = """
import sys
for room in ("pipeline", "disco_twin", "mitsuba", "drjit"):
    sys.modules[room] = None  # importing it fails
import numpy as np
import hw.camera.viva_grabber
import hw.devices.mm_ard
from hw.camera.genicam import CameraFrame
hw.devices.mm_ard.BOOT_S = 0.05

class Grabber:
    def __init__(self, address, pixel_format, shape, *, serial=None):
        self.shape, self.exposure_s, self.count = shape, 0.0, 0

    def identity(self):
        return "a grey camera"

    def set_exposure(self, seconds):
        self.exposure_s = seconds
        return seconds

    def grab(self, timeout_s):
        self.count += 1
        return CameraFrame(np.full(self.shape, 64, np.uint16), float(self.count), self.exposure_s)

    def close(self):
        pass

hw.camera.viva_grabber.VivaGrabber = Grabber
"""


@pytest.mark.parametrize("light", [False, True])
def test_the_script_on_hw_alone(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, light: bool) -> None:
    """Expected: mirrors within their limits and no further, an image; no laser is on, or each is off in the end."""
    dark, lit = blocks(repository, "python")
    assert len([line for line in dark.splitlines() if line]) <= 24
    devices = quick(monkeypatch)
    bench, starts, aims = devices.bench, [], []
    write = bench.board.write

    def aimed(channel: int, value: int, now: float) -> None:
        aims.append((channel, value))
        write(channel, value, now)

    monkeypatch.setattr(bench.board, "write", aimed)
    for head in bench.heads:
        start = head.on_start
        monkeypatch.setattr(head, "on_start", lambda start=start: (starts.append(bench.board.lines), start()))
    with served(RIG, 3, tmp_path / "ports") as path:
        content = path.read_text()
        content = content[: content.index("[[cameras]]")] + CAMERAS[CAMERAS.index("\n[[cameras]]") :]
        content = content.replace("floodlight_line", "limits_u = [400, 3700]\nfloodlight_line", 1)
        (tmp_path / "rig.toml").write_text(content)
        program = ALONE + dark + (lit.replace('{"front": (496, 768)}', '{"front": (31, 48), "back": (31, 48)}') * light)
        done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=60,
                              env=os.environ | {"PYTHONPATH": str(repository)}, check=False)  # fmt: skip
    assert done.returncode == 0 and not done.stderr, done.stderr
    refusal, image, *lasers = done.stdout.splitlines()
    assert refusal.startswith("board.limits_u = 3701: this mirror step is outside the rig's limits (allowed: 400 to 3")
    assert image == "front: (496, 768), brightest 64 DN"
    assert [line for line in lasers if "laser" in line] == [f"laser {nm} nm: 0.00 mW" for nm in (635, 532, 476)]
    assert (0, 400) in aims and all(400 <= value <= 3700 for channel, value in aims if channel == 0)
    assert len(starts) == (3 if light else 0) and (not light or abs(float(lasers[-1].split()[0]) - 10.0) < 0.02)
    assert bench.hazards == [] and bench.board.lines == 0 and not any(head.on_since for head in bench.heads)
