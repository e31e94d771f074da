"""`disco-twin rig emulate`: one emulator a folder, and nothing of it left behind however it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from refusals import Says
from rig_fakes import SCENE
from twin_fakes import RIG

from disco_twin.emulation.served_rig import served


def emulator(scene: Path, ports: Path) -> subprocess.Popen[str]:
    """A program of its own, once it serves."""
    words = ["rig", "emulate", str(scene), "--ports", str(ports), "--seconds", "60"]
    command = [sys.executable, "-c", "from disco_twin.cli.start import main; main()", *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None and "devices are served" in process.stdout.readline()
    return process


def links(ports: Path) -> list[Path]:
    return [path for path in ports.iterdir() if path.is_symlink()]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_emulator_that_is_told_to_end_takes_its_links_away(tmp_path: Path, number: signal.Signals) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    process = emulator(tmp_path / "scene.toml", tmp_path / "ports")
    assert len(links(tmp_path / "ports")) == 5
    process.send_signal(number)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 0 and out.endswith("ended\n") and not err
    assert not links(tmp_path / "ports")


def test_a_folder_has_one_emulator_and_a_dead_one_s_links_are_taken_over(tmp_path: Path, says: Says) -> None:
    scene, ports = tmp_path / "scene.toml", tmp_path / "ports"
    scene.write_text(SCENE)
    process = emulator(scene, ports)
    before = {link: os.readlink(link) for link in links(ports)}
    other = tmp_path / "same"
    other.symlink_to(ports)
    for name in (ports, other):
        said = says("rig", "emulate", scene, "--ports", name, "--seconds", "0.1")
        assert (
            said
            == f"{name}: an emulator that is running serves its devices here. Remedy: end it, or choose another --ports"
        )
    assert {link: os.readlink(link) for link in links(ports)} == before and len(before) == 5
    process.kill()
    process.communicate(timeout=20)
    assert len(links(ports)) == 5
    (ports / "rig.toml").unlink()
    begun = time.monotonic()
    with served(RIG, 3, ports) as path:
        assert path.exists()
    assert not links(ports) and time.monotonic() - begun < 10
