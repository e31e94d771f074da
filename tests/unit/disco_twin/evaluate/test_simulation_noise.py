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
from pipeline.geometry.camera import PinholeCamera

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
    assert f"with {scene.simulation.walks_per_spot} walks a spot" in lines["noise"]
    assert f"{walks_below_camera(scene):.1e} bring it below" in lines["noise"]


def test_measured_noise_reads_the_variances(scene: Scene, tmp_path: Path) -> None:
    """Expected behaviour: with variances made to be four times the camera's, twice its noise, everywhere above it, and
    four times the walks to mend it; nothing where nothing was simulated.
    """
    assert measured_noise(scene, tmp_path) is None
    sensor = lars3_sensor(scene.rig)
    camera = PinholeCamera.from_config(scene.rig.cameras[0])
    mean = np.random.default_rng(2).uniform(1e-9, 1e-4, (3, 2, len(scene.rig.lasers), 8, camera.width))
    mean[..., :9] = 0.0
    variance = np.zeros_like(mean)
    for k, laser in enumerate(scene.rig.lasers):
        watts = laser.power_mw * 1e-3
        variance[:, :, k] = 4 * expected_variance(watts * mean[:, :, k], sensor, k) / watts**2
    np.save(tmp_path / "spots-1.npy", np.stack([mean, variance]).astype(np.float32))
    found = measured_noise(scene, tmp_path)
    assert found is not None
    assert found["median_over_camera"] == pytest.approx(2.0, rel=1e-3)
    assert found["above_camera"] == 1.0
    assert found["walks_below_camera"] == pytest.approx(4 * scene.simulation.walks_per_spot, rel=1e-3)
