"""`disco-twin plan`: what its minutes scale with, and what they count."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from scene_texts import GOOD

from disco_twin.cli.app import main
from disco_twin.evaluate.simulation_noise import spot_cost
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.references import shipped_references
from disco_twin.run import cost_prediction
from disco_twin.run.cost_prediction import predict
from disco_twin.scene.scene import load_scene

SCENE = Path(__file__).parents[4] / "scenes" / "quick.toml"


def simulation_seconds(experiment: Experiment, lights: int, cores: int) -> dict[str, float]:
    """Of the scene as it is."""
    return cost_prediction.simulation_seconds(experiment, spot_cost(experiment), lights, cores)


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return Experiment(load_scene(SCENE))


def changed(experiment: Experiment, **simulation: Any) -> Experiment:
    """The same scene and object with other walks."""
    work = experiment.scene.simulation.model_copy(update=simulation)
    other = Experiment(experiment.scene.model_copy(update={"simulation": work}))
    vars(other).update(object=experiment.object, scan=experiment.scan, plan=experiment.plan)
    return other


@pytest.mark.parametrize(
    ("key", "stage"),
    [
        ("walks_per_spot", "capture"),
        ("truth_columns", "truth"),
        ("truth_walks", "truth"),
    ],
)
def test_a_stage_takes_as_long_as_its_walks(experiment: Experiment, key: str, stage: str) -> None:
    """Expected behaviour: three times the walks, three times that stage, and no other; half the cores, twice all."""
    once = simulation_seconds(experiment, 7, 2)
    more = simulation_seconds(changed(experiment, **{key: 3 * getattr(experiment.scene.simulation, key)}), 7, 2)
    exposures = {"capture": 2 * len(experiment.plan) * cost_prediction.EXPOSURE_S / 2}  # twice: they stay as they are
    for name, value in once.items():
        expected = 3 * value - exposures.get(name, 0.0) if name == stage else value
        assert more[name] == pytest.approx(expected)
    assert simulation_seconds(experiment, 7, 1) == pytest.approx({name: 2 * value for name, value in once.items()})
    assert simulation_seconds(experiment, 14, 2)["references"] == pytest.approx(2 * once["references"])


def test_references_take_as_long_as_their_noise_and_images(experiment: Experiment) -> None:
    """Expected behaviour: a third of the noise, nine times the stage, and no other; one view of the two, half of it."""
    once = simulation_seconds(experiment, 7, 2)
    finer = changed(experiment, reference_noise=experiment.scene.simulation.reference_noise / 3)
    assert simulation_seconds(finer, 7, 2) == pytest.approx(once | {"references": 9 * once["references"]})
    relight = experiment.scene.relight
    single = changed(experiment)
    single.scene = experiment.scene.model_copy(
        update={"relight": relight.model_copy(update={"views": relight.views[:1]})}
    )
    assert simulation_seconds(single, 7, 2) == pytest.approx(once | {"references": once["references"] / 2})


def test_wavelengths_that_scatter_alike_share_their_walks(experiment: Experiment) -> None:
    """Expected behaviour: quick's three lasers walk once; where each scatters by itself, three times."""
    from dataclasses import replace

    medium = experiment.object.medium
    own = medium.sigma_t.copy()
    own[1] *= 1.1
    own[2] *= 1.2
    apart = changed(experiment)
    vars(apart).update(object=replace(experiment.object, medium=replace(medium, sigma_t=own)))
    once, three = spot_cost(experiment), spot_cost(apart)
    assert three.seconds / three.time_walks == pytest.approx(3 * once.seconds / once.time_walks, rel=0.15)


def test_a_budget_is_walks_seconds_or_noise(experiment: Experiment) -> None:
    """Expected behaviour: each key is met by what is predicted of the others; a quarter of the noise, 16 times the
    walks.
    """
    stated = spot_cost(experiment)
    assert stated.time_walks == experiment.scene.simulation.walks_per_spot
    timed = spot_cost(changed(experiment, walks_per_spot=None, spot_seconds=3 * stated.seconds))
    assert timed.time_walks == pytest.approx(3 * stated.time_walks, rel=1e-3)
    finer = spot_cost(changed(experiment, walks_per_spot=None, spot_noise=stated.median / 4))
    assert finer.time_walks == pytest.approx(16 * stated.time_walks, rel=1e-3)
    assert finer.median == pytest.approx(stated.median / 4, rel=1e-3)
    assert all(finer.by_decade[decade] < noise / 3.9 for decade, noise in stated.by_decade.items())


def test_references_beside_the_scene_cost_nothing(experiment: Experiment, tmp_path: Path) -> None:
    """Expected behaviour: a run takes them from there, so the plan counts those that are missing or too noisy."""
    there = dict(predict(experiment, shipped_references(SCENE, "quick")))
    assert "none to render" in there["references"]
    assert "minutes" in dict(predict(experiment, tmp_path))["references"]
    more = changed(experiment, reference_noise=experiment.scene.simulation.reference_noise / 10)
    assert "hours" in dict(predict(more, shipped_references(SCENE, "quick")))["references"]


def test_the_command_warns_of_cameras_that_do_not_see_the_whole_object(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Expected behaviour: a line a camera or view, and the scene is planned all the same."""
    path = tmp_path / "scene.toml"
    path.write_text(GOOD.replace("vertices = 642", "vertices = 162"))
    with pytest.raises(SystemExit) as end:
        main(["plan", str(path)])
    assert end.value.code == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.split()[0] == "warning"]
    assert len(lines) == 3
    for line, name in zip(lines, ("rig.cameras[0]", "relight.views[0]", "relight.views[1]"), strict=True):
        assert "does not see the whole object" in line and f"{name}.focal_length_mm" in line
