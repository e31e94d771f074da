"""Run folder, resume, resource figures."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scene_texts import GOOD

from disco_twin.experiment.keys import content_key, identity
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.object.build import build_object
from disco_twin.scene.scene import load_scene
from hw.base.errors import InputError
from hw.base.files import write_atomically
from hw.base.resources import measured, usable_cores


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.toml"
    path.write_text("name = 'x'\n")
    return path


def test_a_finished_stage_is_not_repeated_and_keeps_its_figures(tmp_path: Path, scene: Path) -> None:
    done: list[str] = []
    for _ in range(2):
        folder = RunFolder.claim(tmp_path / "out", scene, "one")
        folder.run("capture", "k1", lambda: done.append("capture"))
    assert done == ["capture"]
    before = folder.stages["capture"]
    assert RunFolder.open(tmp_path / "out").stages["capture"] == before
    assert folder.run("capture", "k2", lambda: done.append("again"))


def test_an_interrupted_stage_is_repeated_and_its_seconds_add_up(tmp_path: Path, scene: Path) -> None:
    folder = RunFolder.claim(tmp_path / "out", scene, "one")

    def interrupted() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        folder.run("capture", "k", interrupted)
    first = RunFolder.open(tmp_path / "out").stages["capture"]
    assert not first.finished
    again = RunFolder.claim(tmp_path / "out", scene, "one")
    assert again.run("capture", "k", lambda: 123.0)
    assert again.stages["capture"].seconds > first.seconds > 0
    assert again.stages["capture"].peak_mb >= 123.0


def test_a_folder_of_another_scene_or_of_something_else_is_refused(tmp_path: Path, scene: Path) -> None:
    RunFolder.claim(tmp_path / "out", scene, "one")
    with pytest.raises(InputError, match=r"another scene.*Remedy"):
        RunFolder.claim(tmp_path / "out", scene, "two")
    with pytest.raises(InputError, match="not empty"):
        RunFolder.claim(tmp_path, scene, "one")
    with pytest.raises(InputError, match="not a folder"):
        RunFolder.claim(scene, scene, "one")
    with pytest.raises(InputError, match="no run folder"):
        RunFolder.open(tmp_path / "nowhere")


@pytest.mark.parametrize("content", ["", "{}", '{"format_version": 99, "identity": "one", "stages": []}', "[1]"])
def test_a_damaged_or_newer_journal_is_refused_not_misread(tmp_path: Path, scene: Path, content: str) -> None:
    folder = RunFolder.claim(tmp_path / "out", scene, "one")
    folder.journal.write_text(content)
    with pytest.raises(InputError, match=r"stages\.json"):
        RunFolder.open(tmp_path / "out")


def test_the_journal_is_replaced_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for n in (1, 2):
        write_atomically(path, json.dumps(n).encode())
    assert path.read_text() == "2"
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_content_key_tells_parts_apart(tmp_path: Path) -> None:
    file = tmp_path / "f"
    file.write_bytes(b"ab")
    assert content_key(file) == content_key(b"ab") != content_key("ab")
    assert content_key("1") != content_key(1) and content_key("[1, 2]") != content_key([1, 2])
    assert content_key("a", "b") != content_key("ab")
    assert content_key({"a": 1, "b": 2}) == content_key({"b": 2, "a": 1})


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux resets the high-water mark")
def test_the_peak_is_the_blocks_own() -> None:
    with measured() as large:
        assert np.ones(30_000_000).sum() == 30_000_000  # 229 MiB
    with measured() as small:
        pass
    assert large.peak_mb - small.peak_mb > 150
    assert large.seconds > small.seconds >= 0
    assert usable_cores() >= 1


@pytest.mark.parametrize("damage", ["deleted", "cut"])
def test_a_stage_whose_file_is_missing_or_cut_is_done_again(tmp_path: Path, damage: str) -> None:
    folder = RunFolder(tmp_path)
    made = tmp_path / "twin" / "truth.npz"
    made.parent.mkdir()
    work = lambda: made.write_bytes(b"0123456789") and None  # noqa: E731
    assert folder.run("truth", "k", work, ["twin/*.npz"])
    assert not folder.run("truth", "k", work, ["twin/*.npz"])
    if damage == "deleted":
        made.unlink()
    else:
        made.write_bytes(b"01234")
    assert folder.run("truth", "k", work, ["twin/*.npz"])
    assert made.read_bytes() == b"0123456789"


def test_a_flipped_bit_in_a_finished_stage_does_it_again(tmp_path: Path) -> None:
    folder, made = RunFolder(tmp_path), tmp_path / "work" / "made.npy"
    made.parent.mkdir()

    def work() -> None:
        made.write_bytes(b"0123456789")

    assert folder.run("stage", "k", work, ("work/*.npy",))
    assert not folder.run("stage", "k", work, ("work/*.npy",))
    made.write_bytes(b"0123456788")
    assert folder.run("stage", "k", work, ("work/*.npy",))
    assert made.read_bytes() == b"0123456789"


def test_a_damaged_journal_loses_nothing(tmp_path: Path, scene: Path) -> None:
    """Expected behaviour: it is set aside, what lies in the folder stays, and the stages are looked at again; one that
    another version wrote is refused and left alone.
    """
    folder = RunFolder.claim(tmp_path / "out", scene, "one")
    (folder.capture / "images.bin").write_bytes(b"hours of work")
    folder.journal.write_bytes(b"\x00" + folder.journal.read_bytes()[1:])
    again = RunFolder.claim(tmp_path / "out", scene, "one")
    assert (again.capture / "images.bin").read_bytes() == b"hours of work"
    assert again.journal.with_suffix(".damaged").is_file()
    assert again.run("stage", "k", lambda: None)
    newer = '{"format_version": 99, "identity": "one", "stages": []}'
    again.journal.write_text(newer)
    with pytest.raises(InputError, match="format_version"):
        RunFolder.claim(tmp_path / "out", scene, "one")
    assert again.journal.read_text() == newer


def test_a_folder_that_was_moved_holds_what_its_scene_names(tmp_path: Path) -> None:
    there = tmp_path / "there"
    there.mkdir()
    trimesh.creation.icosphere(subdivisions=2, radius=20).export(there / "ball.ply")
    (there / "scene.toml").write_text(GOOD.replace('kind = "sphere"', 'kind = "mesh"\nfile = "ball.ply"', 1))
    scene = load_scene(there / "scene.toml")
    RunFolder.claim(there / "out", there / "scene.toml", identity(scene)).write_scene(scene)
    (there / "out").rename(tmp_path / "out")
    shutil.rmtree(there)
    moved = RunFolder.open(tmp_path / "out")
    found = moved.read_scene()
    assert identity(found) == moved.identity
    assert build_object(found).mesh.volume == pytest.approx(trimesh.creation.icosphere(2, 20).volume, rel=1e-5)
    assert found.relight == scene.relight and found.rig == scene.rig


@pytest.mark.parametrize(
    ("content", "remedy"),
    [
        ("{", "disco-twin run SCENE --out {} begins it anew"),
        ('{"format_version": 2, "identity": 3, "stages": []}', "disco-twin run SCENE --out {} begins it anew"),
        ('{"format_version": 1}', "read it with the version that wrote it, or choose another --out"),
    ],
)
def test_a_journal_that_cannot_be_read_names_what_helps(tmp_path: Path, scene: Path, content: str, remedy: str) -> None:
    folder = RunFolder.claim(tmp_path / "out", scene, "one")
    folder.journal.write_text(content)
    with pytest.raises(InputError) as caught:
        RunFolder.open(folder.root)
    assert str(folder.journal) in str(caught.value) and remedy.format(folder.root) in str(caught.value)
