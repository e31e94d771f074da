"""Spot images by plain and split walks together: unbiased, as bright as before, reproducible."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from significance import assert_z, z_of_difference

from disco_twin.experiment.experiment import Experiment
from disco_twin.faults.actual_rig import actual_rig
from disco_twin.light.spot_walks import SpotWalks
from disco_twin.scene.scene import load_scene
from hw.interface import Aim

F64 = NDArray[np.float64]
SCENES = ("quick", "accuracy/choose/ring", "accuracy/choose/figure", "accuracy/choose/animal")
RUNS, PLAIN, LASER = 16, 40_000, 0


def test_a_spot_does_not_depend_on_its_company(repository: Path, tmp_path: Path) -> None:
    """Rationale: a resumed capture groups its spots otherwise than one that was not interrupted.

    Expected behaviour: the same bits for a spot alone and as the last of three, and other bits for another seed.
    """
    experiment = Experiment(load_scene(repository / "scenes" / "quick.toml"))
    from disco_twin.light.response import SpotResponses

    scene, transport = experiment.scene, experiment.transport
    aims = list(experiment.plan.spots[:3])

    def image(first: list[Aim], name: str, seed: int = 5) -> F64:
        actual, walks = actual_rig(scene.rig, scene.seed), SpotWalks(200, 40)
        light = SpotResponses(transport, scene.rig, actual, walks, seed, tmp_path / name)
        light.prepare(first)
        return np.stack([light.image(camera, aims[2], 0) for camera in range(2)])

    alone, together = image([aims[2]], "alone"), image(aims, "together")
    assert alone.any()
    assert np.array_equal(alone, together)
    assert not np.array_equal(alone, image([aims[2]], "other", 6))
    whole, half = np.load(next((tmp_path / "alone").glob("*.npy")))
    assert half.any()
    assert not np.array_equal(whole, half)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_spot_images_are_those_of_plain_walks(repository: Path, tmp_path: Path, name: str) -> None:
    """Rationale: what captures record must be the object's light whatever it is made of.

    Expected behaviour: by decade of light below a spot's peak and by camera, in total, plain walks' images, |z| as
    large as chance allows, from 16 runs each of three spots; half of the plain runs say which pixel is in which decade.
    """
    experiment = Experiment(load_scene(repository / "scenes" / f"{name}.toml"))
    from disco_twin.light.response import SpotResponses
    from disco_twin.light.sources import BeamSource

    scene, transport = experiment.scene, experiment.transport
    actual = actual_rig(scene.rig, scene.seed)
    aims = list(experiment.plan.spots_at(0))[:60:20]
    spots = [experiment.plan.spots[k] for k in aims]
    joined = []
    for seed in range(RUNS):
        light = SpotResponses(transport, scene.rig, actual, SpotWalks.of(PLAIN // 4, 0.4), seed, tmp_path)
        light.prepare(spots)
        joined.append([[light.image(c, aim, LASER) for c in range(len(scene.rig.cameras))] for aim in spots])
    origins, directions = (np.tile(rays, (2 * RUNS, 1)) for rays in actual.spot_rays(spots))
    beam = scene.rig.projector
    traced = transport.trace(
        lambda group: BeamSource(
            origins, directions, beam.beam_diameter_mm / 2, np.ones((len(origins), len(group))), beam.beam_profile
        ),
        len(origins), PLAIN, seed=99, cameras=[actual.camera(c, 0) for c in range(len(scene.rig.cameras))],
    )  # fmt: skip
    assert traced.images is not None
    plain = traced.images[:, 0, :, LASER].reshape(2 * RUNS, len(spots), *np.shape(joined)[2:]).astype(float)
    level = plain[::2].mean(axis=0)
    level /= np.maximum(level.max(axis=(1, 2, 3), keepdims=True), 1e-30)  # a spot may miss the object
    found = []
    for decade in range(5):
        part = (level <= 10.0**-decade) & (level > 10.0 ** -(decade + 1))
        sums = [np.where(part, images, 0.0).sum(axis=(-1, -2)) for images in (np.array(joined, float), plain[1::2])]
        lit = part.sum(axis=(-1, -2)) >= 20
        found.append(z_of_difference(*[total[:, lit] for total in sums]))
    assert_z(np.concatenate(found), name)
