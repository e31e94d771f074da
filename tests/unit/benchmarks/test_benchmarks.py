"""The benchmarks' command: common keys beside a benchmark's own, one JSON object, a readable table."""

from __future__ import annotations

import importlib.util
import json
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import __main__ as benchmarks
from benchmarks.plot import plot
from benchmarks.rival import ball, tetrahedra


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


def test_curves_become_a_picture(tmp_path: Path) -> None:
    """One panel a decade, one line an estimator; curves of other benchmarks' names are left out."""
    points = [{"seconds": t, "error": t**-0.5} for t in (1.0, 10.0)]
    names = [f"R_d, ball: {n}" for n in ("analogue, decade 0", "effort 3, decade 0", "effort 3, decade -1")] + ["other"]
    record = tmp_path / "walk.json"
    record.write_text(json.dumps({"curves": [{"name": n, "points": points} for n in names]}))
    plot(record, tmp_path / "walk.svg")
    drawn = (tmp_path / "walk.svg").read_text()
    assert "R_d, ball, decade -1" in drawn
    assert "effort 3" in drawn
    assert "other" not in drawn


def test_tetrahedra_fill_the_ball() -> None:
    """The rival's mesh has the ball's volume, every tetrahedron the right way round, and its medium's mean."""
    obj = ball()
    nodes, cells, medium, rows = tetrahedra(obj)
    a, b, c, d = (nodes[cells[:, k] - 1] for k in range(4))
    volume = np.einsum("ij,ij->i", b - a, np.cross(c - a, d - a)) / 6
    assert volume.min() >= 0
    assert volume.sum() == pytest.approx(obj.mesh.volume, rel=1e-9)
    sigma_t = (rows[medium, :2].sum(axis=1) * volume).sum() / volume.sum()
    assert sigma_t == pytest.approx(float(obj.medium.sigma_t.mean()), rel=0.01)
