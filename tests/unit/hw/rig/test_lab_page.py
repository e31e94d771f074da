"""The lab page's examples are files that work."""

from __future__ import annotations

import re
from pathlib import Path

import trimesh

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
