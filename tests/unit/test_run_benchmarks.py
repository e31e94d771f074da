"""The benchmarks' command: common keys beside a benchmark's own, one JSON object, a readable table."""

from __future__ import annotations

import importlib.util
import json
import sys
import types
from pathlib import Path
from typing import Any

import pytest

from benchmarks import __main__ as benchmarks


def fake(quick: bool) -> dict[str, Any]:
    return {"walks_per_s": 12345.0, "curves": [{"name": "a", "points": [{"seconds": 1.0, "error": 0.5}]}]}


def test_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    module = types.ModuleType("fake_benchmark")
    module.run = fake  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "fake_benchmark", module)
    monkeypatch.setitem(benchmarks.REGISTRY, "fake", "fake_benchmark")
    assert benchmarks.main(["fake", "--json", str(tmp_path / "deep" / "f.json"), "--quick"]) == 0
    record = json.loads((tmp_path / "deep" / "f.json").read_text())
    assert {"format_version", "name", "quick", "commit", "cores", "cpu_over_wall", "seconds", "peak_mb"} < set(record)
    assert (record["name"], record["quick"], record["walks_per_s"]) == ("fake", True, 12345.0)
    assert record["peak_mb"] > 10
    assert "error 0.5" in capsys.readouterr().out


@pytest.mark.parametrize("name", sorted(benchmarks.REGISTRY))
def test_registered_modules_exist(name: str) -> None:
    assert importlib.util.find_spec(benchmarks.REGISTRY[name]) is not None


def test_an_unknown_name_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as stop:
        benchmarks.main(["nothing", "--json", str(tmp_path / "f.json")])
    assert stop.value.code == 2
