"""Bad input gets one line on stderr and exit status 2, never a traceback."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from scene_texts import GOOD

from disco_twin.cli.app import main
from disco_twin.run import stages as run_module
from hw.base.errors import DiscoError
from pipeline.capture.loop import Interrupted


def status_and_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    code = stop.value.code
    assert isinstance(code, int)
    return code, lines[0]


def edited(folder: Path, old: str = "", new: str = "") -> Path:
    """The file of a scene that is in order, and quickly built, but for one change."""
    assert old in GOOD
    path = folder / "scene.toml"
    path.write_text(GOOD.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name = "good"', 'name = "good', "not valid TOML"),
        ('name = "good"', 'name = "good"\nsede = 3', "seed"),
        ("[scan]", "[rig]\nspots = 0\n[scan]", "rig.spots"),
        ("width = 192", "aim_mm = [900.0, 0.0, 0.0]\nwidth = 192", "does not see the object"),
        ("[scan]", "[rig.projector]\naim_mm = [600.0, 900.0, 0.0]\n[scan]", "never hits the object"),
        ("radius_mm = 3.0", "radius_mm = -3.0", "radius_mm"),
    ],
)
def test_bad_scenes(old: str, new: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = edited(tmp_path, old, new)
    status, line = status_and_line(["run", str(scene), "--out", str(tmp_path / "out")], capsys)
    assert status == 2
    assert said in line


def test_a_missing_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, line = status_and_line(["run", str(tmp_path / "no.toml"), "--out", str(tmp_path / "out")], capsys)
    assert status == 2
    assert "no such file" in line


def test_the_folder_of_another_scene(repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    quick = repository / "scenes" / "quick.toml"
    run_module.begin_run(quick, tmp_path / "out", "small", None, run_module.Console(quiet=True))
    for arguments in (["run", str(quick)], ["capture", str(repository / "scenes" / "slab.toml")]):
        status, line = status_and_line([*arguments, "--out", str(tmp_path / "out")], capsys)
        assert status == 2
        assert "another scene" in line


def test_an_unknown_method_names_the_known_ones(
    repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quick = str(repository / "scenes" / "quick.toml")
    status, line = status_and_line(["run", quick, "--out", str(tmp_path / "out"), "--methods", "disco2005"], capsys)
    assert status == 2
    assert "disco2005" in line
    assert "disco2004" in line


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "out/x"), 2, "out/x: the disk is full. Remedy"),
        (OSError("7 requested and 0 written"), 2, "out: the disk is full. Remedy"),
        (OSError(errno.EROFS, os.strerror(errno.EROFS), "out/x"), 2, "out/x: read-only file system. Remedy"),
        (Interrupted("stopped: 3 of 9 images are stored; the same command continues"), 130, "same command continues"),
        (KeyboardInterrupt(), 130, "stopped during scan; the same command continues"),
        (DiscoError("the reason"), 2, "the reason"),
    ],
)
def test_what_goes_wrong_later(
    error: BaseException,
    status: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("disco_twin.run.scan.write_scan", fail)
    found, line = status_and_line(["run", str(edited(tmp_path)), "--out", str(tmp_path / "out")], capsys)
    assert found == status
    assert said in line


def test_score_without_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, line = status_and_line(["score", "--out", str(tmp_path)], capsys)
    assert status == 2
    assert "no run folder" in line
