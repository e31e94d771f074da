"""The references that ship belong to the scene as it is, and are what the walk renders today.

Rationale: scores are only as good as the images that they compare with. A changed scene with old references, or a
changed walk, must not go unnoticed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from significance import assert_z

from disco_twin.experiment.references import reference_key, reference_path
from disco_twin.light.references import load_reference, noise_of
from disco_twin.light.rendering import MARGIN, from_light
from disco_twin.light.transport import Transport
from disco_twin.object.build import build_object
from disco_twin.scene.scene import load_scene
from pipeline.geometry.camera import PinholeCamera

REPLICATES, WALKS, BLOCK = 16, 60_000, 31  # large blocks: the noise of small ones is far from normal
LIGHT = "edge"


def block_means(image: np.ndarray) -> np.ndarray:
    """(..., H, W) -> (..., blocks) means over whole blocks of `BLOCK`^2 pixels."""
    height, width = (n // BLOCK for n in image.shape[-2:])
    cut = image[..., : height * BLOCK, : width * BLOCK]
    shape = (*image.shape[:-2], height, BLOCK, width, BLOCK)
    return np.asarray(cut.reshape(shape).mean(axis=(-3, -1)).reshape(*image.shape[:-2], -1))


def z_scores(ours: np.ndarray, theirs: np.ndarray, share: float) -> np.ndarray:
    """(N, ...) replicates against one image; share: variance of the difference over a replicate's."""
    return np.asarray((ours.mean(axis=0) - theirs) / (ours.std(axis=0, ddof=1) * np.sqrt(share)))


def test_shipped_references_belong_to_the_scene(repository: Path) -> None:
    """Expected: every light and view has its file, made from this very object, light and camera."""
    scene = load_scene(repository / "scenes" / "quick.toml")
    folder = repository / "scenes" / "references" / scene.name
    for light in scene.relight.lights:
        for view in scene.relight.views:
            reference = load_reference(reference_path(folder, light, view))
            assert reference.key == reference_key(scene, light, view)
            assert reference.noise <= scene.simulation.reference_noise
            assert noise_of(reference.halves) < MARGIN * reference.noise
            assert reference.halves.shape == (2, 2, len(scene.rig.lasers), view.height, view.width)


@pytest.mark.slow
def test_a_shipped_reference_is_rendered_again(repository: Path) -> None:
    """Expected: new photons, few of them, agree with the shipped image block by block, layer by layer; with one that is
    three per cent brighter they do not.

    The shipped image comes from the same estimator, so its variance is a replicate's, scaled by the noise over it.
    """
    scene = load_scene(repository / "scenes" / "quick.toml")
    light = next(light for light in scene.relight.lights if light.name == LIGHT)
    folder = repository / "scenes" / "references" / scene.name
    shipped = [load_reference(reference_path(folder, light, view)) for view in scene.relight.views]
    cameras = [PinholeCamera.from_config(view) for view in scene.relight.views]
    transport = Transport(build_object(scene))
    renders = [from_light(transport, light, camera, 900) for camera in cameras]
    halves = [[render(WALKS, 1 + k) for render in renders] for k in range(REPLICATES // 2)]
    for view, reference in enumerate(shipped):
        again = block_means(np.concatenate([h[view] for h in halves]).astype(float))  # (N, layer, laser, block)
        there = block_means(reference.halves.astype(float).mean(axis=0))
        lit = (again > 0).all(axis=0)
        assert lit[0].sum() >= 24
        one = 2 * np.mean([noise_of(h[view]) ** 2 for h in halves])  # squared, of a replicate
        share = 1 / REPLICATES + noise_of(reference.halves) ** 2 / one
        # Student's t with 15 degrees of freedom has heavier tails than the normal distribution: this level keeps 1e-3.
        assert_z(z_scores(again[:, lit], there[lit], share), f"view {view}, blocks", level=1e-5)
        assert_z(z_scores(again.sum(axis=-1), there.sum(axis=-1), share), f"view {view}, sums", level=1e-4)
        with pytest.raises(AssertionError, match="sums"):  # noise leaves three per cent in plain sight
            assert_z(z_scores(again.sum(axis=-1), 1.03 * there.sum(axis=-1), share), f"view {view}, sums", level=1e-4)
