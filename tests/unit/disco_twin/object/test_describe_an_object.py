"""docs/howto/describe-an-object.md as it stands: its blocks make one scene, whose object is built."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scene_texts import GOOD

from disco_twin.object import shapes
from disco_twin.object.build import build_object
from disco_twin.scene.scene import load_scene


def test_the_page(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shapes, "SUBDIVISIONS", 3)
    page = (repository / "docs" / "howto" / "describe-an-object.md").read_text()
    blocks = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (grid,) = re.findall(r"```toml-grid\n(.*?)```", page, re.DOTALL)
    head, rest = GOOD[: GOOD.index("[object.medium.base]")], GOOD[GOOD.index("[scan]") :]
    (tmp_path / "scene.toml").write_text("\n".join([head, *blocks, rest]))
    obj = build_object(load_scene(tmp_path / "scene.toml"))
    assert obj.medium.g_voxels is not None and len(obj.inside) == 3
    for name, value in (("sigma_t", 1.0), ("albedo", 0.9), ("g", 0.7)):
        np.save(tmp_path / f"{name}.npy", np.full((4, 4, 4), value))
    (tmp_path / "scene.toml").write_text("\n".join([head, grid, rest]))
    medium = build_object(load_scene(tmp_path / "scene.toml")).medium
    assert medium.g_voxels is not None and medium.g == pytest.approx((0.7,) * 3)
