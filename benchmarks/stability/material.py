"""What several families are made of: scenes with one key changed; the samples that the tests complete."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from disco_twin.scene.scene import Scene
from hw.base.config import check

SUPPORT = Path(__file__).parents[2] / "tests" / "support"
CAMERA = {"position_mm": [450.0, 0.0, 50.0], "width": 32, "height": 32}


def support(name: str) -> Any:
    """A module of tests/support: objects and known answers that the tests have too."""
    if str(SUPPORT) not in sys.path:
        sys.path.append(str(SUPPORT))
    return importlib.import_module(name)


def scene_with(changes: dict[str, Any]) -> Scene:
    """A sphere's scene with some keys, named by their path, set. Raises: InputError as a file with these keys would."""
    data: dict[str, Any] = {
        "format_version": 1,
        "name": "stress",
        "object": {
            "shape": {"kind": "sphere"},
            "medium": {"base": {"kind": "homogeneous", "sigma_t_per_mm": 1.0, "albedo": 0.9}},
        },
        "scan": {"vertices": 162},
        "rig": {"cameras": [CAMERA | {"name": "a"}], "spots": 20},
        "relight": {"views": [CAMERA | {"name": "b"}, CAMERA | {"name": "c"}]},
    }
    for key, value in changes.items():
        *parents, last = key.split(".")
        table = data
        for name in parents:
            table = table.setdefault(name, {})
        table[last] = value
    return check(data, Scene, Path("scene.toml"))
