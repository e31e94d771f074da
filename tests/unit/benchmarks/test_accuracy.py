"""The record of the accuracy benchmark: means, what is lost, objects that fail; and the whole on a shrunken object."""

from __future__ import annotations

import json
import logging
import math
from pathlib import Path
from typing import Any

import pytest

from benchmarks import accuracy, accuracy_choose
from benchmarks.__main__ import main
from benchmarks.accuracy_table import BEGIN, END, filled
from disco_twin.scene.scene import load_scene
from hw.base.errors import InputError
from pipeline.capture.loop import Interrupted

LIGHTS = ("uniform", "edge")
LIGHTS_OF_QUICK = ("uniform", "directional")


def figures(name: str, default: float, dipole: float, error: float = 1e-3) -> dict[str, Any]:
    """Of one object: the same nrmse under both lights, and pairs that agree with them."""
    nrmse = {"default": dict.fromkeys(LIGHTS, default), "dipole": dict.fromkeys(LIGHTS, dipole)}
    row = {"object": name, "baseline": "dipole", "difference": default**2 - dipole**2, "standard_error": error}
    return {
        "nrmse": nrmse,
        "views": {m: {x: {"left": v, "right": v} for x, v in own.items()} for m, own in nrmse.items()},
        "paired": [row | {"light": light} for light in LIGHTS],
        "seconds": {"default": 3.0, "dipole": 1.0},
        "memory": {"default": 300.0, "dipole": 200.0},
        "stages": {"capture": 60.0},
    }


def reported(monkeypatch: pytest.MonkeyPatch, made: dict[str, Any], beside: tuple[str, ...] = ()) -> dict[str, Any]:
    def fake(scene: Path, folder: Path, profile: str) -> dict[str, Any]:
        result = made[scene.stem]
        if isinstance(result, BaseException):
            raise result
        assert folder == Path("runs") / scene.stem
        return dict(result)

    monkeypatch.setattr(accuracy, "object_figures", fake)
    return accuracy.report([Path(f"{name}.toml") for name in made], Path("runs"), beside=beside)


def test_means_are_over_the_set_and_quick_stands_beside(monkeypatch: pytest.MonkeyPatch) -> None:
    made = {"a": figures("a", 0.1, 0.2), "b": figures("b", 0.2, 0.4), "quick": figures("quick", 0.9, 0.9)}
    record = reported(monkeypatch, made, beside=("quick",))
    assert set(record["objects"]) == {"a", "b", "quick"}
    assert record["mean"] == {
        "default": pytest.approx(dict.fromkeys(LIGHTS, 0.15)),
        "dipole": pytest.approx(dict.fromkeys(LIGHTS, 0.3)),
    }
    assert record["seconds"]["b"] == {"default": 3.0, "dipole": 1.0}
    assert json.loads(json.dumps(record, allow_nan=False)) == record


def test_lost_is_what_a_baseline_does_better_beyond_three_standard_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    made = {
        "lost": figures("lost", 0.2, 0.1, error=0.0099),
        "open": figures("open", 0.2, 0.1, error=0.0101),
        "won": figures("won", 0.1, 0.2, error=1e-6),
    }
    record = reported(monkeypatch, made)
    assert {(row["object"], row["light"]) for row in record["lost"]} == {("lost", light) for light in LIGHTS}
    assert record["lost"][0]["difference"] == pytest.approx(0.03)
    assert set(record["lost"][0]) == {"object", "light", "baseline", "difference", "standard_error"}


def test_a_failed_object_does_not_lose_the_others(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made = {
        "refused": InputError("too few points", key="points"),
        "good": figures("good", 0.1, 0.2),
        "broken": ZeroDivisionError("division by zero"),
    }
    with caplog.at_level(logging.ERROR):
        record = reported(monkeypatch, made)
    assert [row["object"] for row in record["failed"]] == ["refused", "broken"]
    assert "too few points" in record["failed"][0]["because"]
    assert record["failed"][1]["because"] == "ZeroDivisionError: division by zero"
    assert list(record["objects"]) == ["good"]
    with pytest.raises(Interrupted):
        reported(monkeypatch, {"stopped": Interrupted("stopped")})
    nothing = reported(monkeypatch, {"refused": InputError("too few points", key="points")})
    assert (nothing["objects"], nothing["mean"], nothing["lost"]) == ({}, {}, [])


def test_the_sets_are_apart() -> None:
    choose, score = (accuracy.set_of(name) for name in ("choose", "score"))
    assert (len(choose), len(score)) == (3, 4)
    assert not {path.stem for path in choose} & {path.stem for path in score}


def test_the_page_takes_the_tables_of_a_record(monkeypatch: pytest.MonkeyPatch) -> None:
    made = {"a": figures("a", 0.2, 0.1), "b": figures("b", 0.1, 0.25), "c": InputError("too few points", key="points")}
    record = reported(monkeypatch, made) | {"commit": "abc", "cores": 2}
    page = f"# Page\n{BEGIN}old\n{END}rest\n"
    text = filled(page, record)
    assert text.startswith("# Page\n") and text.endswith(f"{END}rest\n") and "old" not in text
    assert "| a | default | .200 | .200 | 3 | 300 |" in text
    assert "|  | dipole | .100 * | .100 * | 1 | 200 |" in text
    assert "| **mean of the set** | default | .150 | .150 |  |  |" in text
    assert "Lost, 2 of 4 pairs" in text
    assert "| a | uniform | dipole | .0300 | .0010 | 30 |" in text
    assert "Failed: c (points: too few points" in text
    assert filled(text, record) == text
    with pytest.raises(ValueError, match="no lines"):
        filled("# Page\n", record)


@pytest.mark.parametrize("module", [accuracy, accuracy_choose])
def test_quick_relights_one_object_of_the_set_under_two_lights(
    module: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Any, ...]] = []
    monkeypatch.setattr(accuracy, "RUNS", tmp_path)
    monkeypatch.setattr(accuracy, "report", lambda *given: asked.append(given) or {})
    module.run(quick=True)
    ((scenes, runs, profile),) = asked
    scene = load_scene(scenes[0], profile)
    assert (scene.name, runs) == (module.QUICK_OBJECT, tmp_path / "small")
    assert [light.name for light in scene.relight.lights] == list(LIGHTS_OF_QUICK)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_one_shrunken_object(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`python -m benchmarks accuracy --quick` from capture to record; again, and nothing is rendered again."""
    monkeypatch.setattr(accuracy, "RUNS", tmp_path / "runs")
    assert main(["accuracy", "--quick", "--json", str(tmp_path / "a.json")]) == 0
    record = json.loads((tmp_path / "a.json").read_text())
    assert record["failed"] == []
    own = record["objects"][accuracy.QUICK_OBJECT]
    assert record["mean"] == own
    assert set(own) == {"default", "disco2004", "lambertian", "dipole"}
    for method, lights in own.items():
        for light, error in lights.items():
            views = record["views"][accuracy.QUICK_OBJECT][method][light].values()
            mean = sum(v * abs(v) for v in views) / 2
            assert error == pytest.approx(math.copysign(math.sqrt(abs(mean)), mean))
    for row in record["paired"]:
        expected = own["default"][row["light"]] ** 2 - own[row["baseline"]][row["light"]] ** 2
        assert row["difference"] == pytest.approx(expected, rel=1e-6, abs=1e-9)
        assert row["standard_error"] > 0
    assert len(record["paired"]) == 2 * 3
    assert f"{accuracy.QUICK_OBJECT:<10} default" in capsys.readouterr().out
    assert main(["accuracy", "--quick", "--json", str(tmp_path / "b.json")]) == 0
    again = json.loads((tmp_path / "b.json").read_text())
    assert again["objects"] == record["objects"]
    assert again["seconds"] == record["seconds"]  # of that time: nothing was done again
