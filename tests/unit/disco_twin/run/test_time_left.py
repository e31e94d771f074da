"""How much longer a whole run takes: by what is asked for, at the pace of what is done."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from disco_twin.run import time_left
from disco_twin.run.progress import stage_bar
from disco_twin.run.time_left import QUICK_S, TimeLeft, in_words
from disco_twin.scene.scene import Scene, load_scene

SCENE = Path(__file__).parents[4] / "scenes" / "quick.toml"


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    monkeypatch.setattr(time_left, "usable_cores", lambda: 2)
    return load_scene(SCENE)


def test_quick_takes_what_it_took(scene: Scene) -> None:
    left = TimeLeft(scene)
    assert left.seconds() == pytest.approx(sum(QUICK_S.values()), rel=0.01)
    work = scene.simulation.model_copy(update={"truth_walks": 3 * scene.simulation.truth_walks})
    more = TimeLeft(scene.model_copy(update={"simulation": work}), missing=2)
    assert more.seconds() == pytest.approx(left.seconds() + 2 * QUICK_S["truth"] + 2 * time_left.REFERENCE_S)


def test_the_pace_is_that_of_what_is_done(scene: Scene) -> None:
    """A machine three times as slow: so is what is to come. What was finished before says nothing."""
    left = TimeLeft(scene)
    left.finished("scan", 0.9)
    left.finished("references", 200.0)  # shipped ones did not fit: says nothing of the others
    left.finished("targets", None)
    assert left.pace == 1.0
    left.finished("capture", 3 * left.expected["capture"])
    later = sum(QUICK_S[name] for name in ("pipeline", "scores"))
    assert left.pace == pytest.approx(3.0, rel=0.01)
    assert left.seconds("truth", 7.0) == pytest.approx(7.0 + left.pace * later, rel=0.01)


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.2, "5 s"), (62, "60 s"), (89, "90 s"), (179, "3 min"), (5000, "83 min"), (9000, "2.5 h")]
)
def test_in_words(seconds: float, words: str) -> None:
    assert in_words(seconds) == words


def test_the_bar_shows_the_whole() -> None:
    shown = io.StringIO()
    with stage_bar(
        Console(file=shown, force_terminal=True, width=120), "truth", "columns", lambda _: "whole 3 min"
    ) as at:
        at(1, 2)
    assert "whole 3 min" in shown.getvalue()
