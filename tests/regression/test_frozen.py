"""The pipeline of now on three frozen captures, against the scores that are stored beside them.

Rationale: a change that makes a stage a tenth worse is to be noticed, and to name the stage. Captures, truth and
references are files, so that nothing but the pipeline can move a figure. `make regression` shows the differences;
`python -m benchmarks.frozen store` stores the scores of a change that makes figures better.
"""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from failing_images import images_on_failure

from benchmarks.frozen import SCENES, Frozen, differences, grown
from benchmarks.frozen_scores import load_scores
from benchmarks.regression import LEVEL, by_chance, caught
from disco_twin.evaluate.stage_figures import FIGURES, StageOutputs
from pipeline.reconstruct.samples.samples_file import load_samples

CALIBRATED = "quick"


@pytest.fixture(scope="module", params=SCENES)
def frozen(request: pytest.FixtureRequest) -> Frozen:
    return Frozen.load(request.param)


@pytest.fixture(scope="module")
def work(frozen: Frozen, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, StageOutputs]:
    """What the pipeline of now makes of it, and where. It calibrates one of them itself: that takes the longest."""
    root = tmp_path_factory.mktemp(frozen.name)
    calibration = None if frozen.name == CALIBRATED else load_scores(frozen.scores_file)[0].calibration
    return root, frozen.reconstruct(root, calibration)


def test_no_figure_of_any_stage_is_worse(frozen: Frozen, work: tuple[Path, StageOutputs]) -> None:
    """By more than rounding and the noise of truth and references explain, at .001 over all figures of all objects."""
    outputs = work[1]
    own, slack = differences(frozen, outputs)
    assert {d.figure for d in own} == set(slack)  # none has gone
    bad = grown(own, slack)
    shown = [d.figure.removeprefix("relit/").split(" ")[0] for d in bad if d.stage == "relit"]
    with ExitStack() as stack:
        for light, view in (name.split("@") for name in dict.fromkeys(shown)):
            image = np.where(frozen.true.masks[view], outputs.images[light, view], 0.0)
            mean = frozen.true.halves[light, view].mean(axis=0)
            stack.enter_context(images_on_failure(f"{frozen.name} {light}@{view}", image, mean))
        assert not bad


def test_the_rig_is_calibrated_from_its_own_images(frozen: Frozen, work: tuple[Path, StageOutputs]) -> None:
    """Reprojection at most .15 px."""
    found = json.loads((work[0] / "work" / "pipeline.json").read_text())["calibration"]
    if frozen.name != CALIBRATED:
        assert found["source"] == "given"
        return
    assert found["source"] == "measured"
    assert len(found["lenses"]) == 2
    assert all(lens["reprojection_px"] <= 0.15 for lens in found["lenses"])


def test_most_spots_are_used(work: tuple[Path, StageOutputs]) -> None:
    """Of the ring some go through its hole."""
    assert (load_samples(work[0] / "work" / "samples.npz").spots.transmitted > 0).mean() > 0.7


def test_a_stage_made_a_tenth_worse_is_caught() -> None:
    """Each stage of one object, by two perturbations; over all objects `python -m benchmarks regression` tells."""
    frozen = Frozen.load("quick")
    stored, slack = load_scores(frozen.scores_file)
    one = {key: stored.images[key] for key in list(stored.images)[:2]}
    found = caught(StageOutputs(**vars(stored) | {"images": one}), slack, frozen.true, 2)
    assert set(found) == set(FIGURES)
    assert all(own and all(own) for own in found.values()), found


def test_what_errs_alike_is_called_worse_as_rarely_as_stated() -> None:
    frozen = Frozen.load("quick")
    stored, _ = load_scores(frozen.scores_file)
    chances = [d.chance() for d in by_chance(stored, frozen.true, 8, 0)]
    assert len(chances) > 150
    share = np.mean(np.array(chances) < LEVEL)
    assert share < LEVEL + 4 * np.sqrt(LEVEL / len(chances) * 4)  # figures of one draw are not independent
