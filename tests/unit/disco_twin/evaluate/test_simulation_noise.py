"""The simulation's noise beside the camera's: predicted before a run, measured after it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from disco_twin.camera.lars3 import Lars3, lars3_sensor
from disco_twin.camera.sensor import expected_variance
from disco_twin.evaluate.simulation_noise import measured_noise, splat, walks_below_camera
from disco_twin.experiment.experiment import Experiment
from disco_twin.run.cost_prediction import predict
from disco_twin.scene.scene import Scene, load_scene
from hw.record import to_radiance

SCENE = Path(__file__).parents[4] / "scenes" / "quick.toml"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(SCENE)


@pytest.mark.parametrize("radiance", [1e-11, 1e-9, 3e-8, 1e-6, 2e-5])
def test_expected_variance_is_that_of_exposures(scene: Scene, radiance: float) -> None:
    """Rationale: walks are counted against the camera's noise; an exposure too long halves it.

    Expected behaviour: the variance of 20 000 exposed pixels, within five standard errors; near a decision between
    exposures it lies between those of the two.
    """
    sensor = lars3_sensor(scene.rig)
    camera = Lars3(sensor, np.ones((100, 200), np.float32))
    raw = camera.expose(np.full((100, 200), radiance, np.float32), 0, np.random.default_rng(1))
    assert np.ptp(raw.exponent) == 0
    found = to_radiance(raw, sensor, 0).radiance.astype(float).var()
    expected = float(expected_variance(np.array([radiance]), sensor, 0)[0])
    assert found == pytest.approx(expected, rel=5 * np.sqrt(2 / 20_000))


def test_the_walks_that_are_stated_bury_the_simulations_noise(scene: Scene) -> None:
    """Rationale: splats of one size drawn as they fall, Poisson, and photographed by the twin's camera, against the
    same radiance without noise.

    Expected behaviour: with the walks that are stated the two noises are equal at the worst radiance, so the variance
    is twice the camera's there and less everywhere else; with half the walks it is three times.
    """
    sensor, rng = lars3_sensor(scene.rig), np.random.default_rng(5)
    camera, watts = Lars3(sensor, np.ones((100, 200), np.float32)), scene.rig.lasers[0].power_mw * 1e-3
    one = scene.model_copy(update={"rig": scene.rig.model_copy(update={"lasers": scene.rig.lasers[:1]})})

    def spread(image: np.ndarray) -> float:
        seen = camera.expose(image.astype(np.float32), 0, rng)
        return float(to_radiance(seen, sensor, 0).radiance.astype(float).var())

    def worst(walks: float) -> float:
        size = watts * splat(one) / walks  # radiance that a walk adds to the pixel that it meets
        levels = np.geomspace(1e-11, 2e-5, 40)
        return max(
            spread(size * rng.poisson(level / size, (100, 200))) / spread(np.full((100, 200), level))
            for level in levels
        )

    walks = walks_below_camera(one)
    assert worst(walks) == pytest.approx(2.0, rel=0.1)
    assert worst(walks / 2) == pytest.approx(3.0, rel=0.1)


def test_smoother_boundaries_and_many_cameras_ask_for_more_walks(scene: Scene) -> None:
    """Expected behaviour: in proportion to the splat, whose size is measured in tests/validation/test_estimators.py."""
    walks = walks_below_camera(scene)
    smooth = scene.object.boundary.model_copy(update={"alpha": 0.05})
    smoother = scene.model_copy(update={"object": scene.object.model_copy(update={"boundary": smooth})})
    assert walks_below_camera(smoother) / walks == pytest.approx(splat(smoother) / splat(scene))
    assert splat(smoother) > 2 * splat(scene)
    crowd = scene.model_copy(update={"rig": scene.rig.model_copy(update={"cameras": scene.rig.cameras * 12})})
    assert walks_below_camera(crowd) == pytest.approx(4 * walks)


def test_plan_says_how_many_walks(scene: Scene, tmp_path: Path) -> None:
    """Expected behaviour: the plan of the quick scene names its walks, and those that bury their noise."""
    lines = dict(predict(Experiment(scene), tmp_path))
    assert f"the time of {scene.simulation.walks_per_spot} plain walks a spot" in lines["noise"]
    assert f"{walks_below_camera(scene):.1e} plain walks bring it below" in lines["noise"]


def test_measured_noise_is_how_the_halves_differ(scene: Scene, tmp_path: Path) -> None:
    """Expected behaviour: halves drawn with a variance that leaves their mean twice the camera's deviation: twice, in
    every decade, above it everywhere but where no light arrived, which counts as above ten; nothing where nothing was
    simulated.
    """
    assert measured_noise(scene, tmp_path) is None
    sensor, rng = lars3_sensor(scene.rig), np.random.default_rng(2)
    light = np.broadcast_to(np.geomspace(3e-3, 3e-6, 80), (3, 2, len(scene.rig.lasers), 60, 80)).copy()
    halves = np.stack([light, light])
    for k, laser in enumerate(scene.rig.lasers):
        watts = laser.power_mw * 1e-3
        deviation = np.sqrt(2 * 4 * expected_variance(watts * light[:, :, k], sensor, k)) / watts
        halves[:, :, :, k] += deviation * rng.standard_normal(halves[:, :, :, k].shape)
    assert (halves > 0).all()
    halves[:, 0, :, :, :12] = 0.0  # of the first spot alone: the other two show that the object is there
    np.save(tmp_path / "spots-1.npy", np.stack([halves.mean(axis=0), halves[0]]).astype(np.float32))
    found = measured_noise(scene, tmp_path)
    assert found is not None
    assert found["median_over_camera"] == pytest.approx(2.0, rel=0.03)
    assert found["unreached_object"] == pytest.approx(12 / 60 / 3)
    assert found["above_ten_object"] == found["unreached_object"]
    assert found["above_camera_object"] > 0.99
    for decade in ("0", "-1", "-2"):
        assert found["by_decade"][decade]["over_camera"] == pytest.approx(2.0, rel=0.05)
