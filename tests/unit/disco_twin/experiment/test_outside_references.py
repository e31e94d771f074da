"""Outside references go with a run where a scene ships some of its own, and are otherwise as if they were not there."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from scene_fakes import sphere

from disco_twin.experiment.references import (
    keep_outside_references,
    load_outside_reference,
    outside_folder,
    reference_key,
    reference_path,
    render_references,
)
from disco_twin.light.references import Reference, save_reference
from disco_twin.scene.scene import Scene

SCENE = sphere().scene
LIGHT, VIEW = SCENE.relight.lights[0], SCENE.relight.views[0]
HALVES = np.ones((2, 2, 3, 32, 32), np.float32)


def write(folder: Path, scene: Scene = SCENE) -> Path:
    path = reference_path(outside_folder(folder), LIGHT, VIEW)
    save_reference(path, Reference(HALVES, 0.1, reference_key(scene, LIGHT, VIEW)))
    return path


def test_those_of_the_scene_are_copied(tmp_path: Path) -> None:
    shipped, own = tmp_path / "shipped", tmp_path / "own"
    path = write(shipped)
    keep_outside_references(SCENE, shipped, own)
    assert [p.relative_to(own) for p in own.rglob("*.exr")] == [path.relative_to(shipped)]
    found = load_outside_reference(own, SCENE, LIGHT, VIEW)
    assert found is not None
    np.testing.assert_allclose(found.halves, HALVES, rtol=1e-3)
    assert load_outside_reference(own, SCENE, LIGHT, SCENE.relight.views[1]) is None
    before = path.stat().st_mtime_ns
    keep_outside_references(SCENE, shipped, shipped)
    assert path.stat().st_mtime_ns == before


def test_without_any_nothing_is_made(tmp_path: Path) -> None:
    keep_outside_references(SCENE, tmp_path / "nowhere", tmp_path / "own")
    assert not list(tmp_path.iterdir())


def test_those_of_another_object_are_left_where_they_are(tmp_path: Path) -> None:
    boundary = SCENE.object.boundary.model_copy(update={"eta": 1.4})
    other = SCENE.model_copy(update={"object": SCENE.object.model_copy(update={"boundary": boundary})})
    write(tmp_path / "shipped", other)
    keep_outside_references(SCENE, tmp_path / "shipped", tmp_path / "own")
    assert load_outside_reference(tmp_path / "shipped", SCENE, LIGHT, VIEW) is None
    assert load_outside_reference(tmp_path / "shipped", other, LIGHT, VIEW) is not None
    assert not (tmp_path / "own").exists()


def test_a_damaged_one_is_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write(tmp_path)
    path.write_bytes(path.read_bytes()[:500])
    with caplog.at_level(logging.WARNING):
        assert load_outside_reference(tmp_path, SCENE, LIGHT, VIEW) is None
    assert str(path) in caplog.text and "Remedy: delete it" in caplog.text


def test_they_do_not_stand_in_for_ordinary_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Expected behaviour: a folder that holds the outside reference of a light still has that light rendered."""
    asked: list[str] = []
    monkeypatch.setattr(
        "disco_twin.experiment.references._render", lambda experiment, light, views, own: asked.append(light.name)
    )
    write(tmp_path / "shipped")
    render_references(sphere(), tmp_path / "shipped", tmp_path / "own", lambda done, total: None)
    assert asked == [light.name for light in SCENE.relight.lights]
    assert load_outside_reference(tmp_path / "own", SCENE, LIGHT, VIEW) is not None
