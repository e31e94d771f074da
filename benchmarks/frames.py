"""Frames as the twin captures them at the Lars III's full size, for benchmarks of what is done with frames.

The object, spots, camera model, noise and capture loop are the shipped `quick` scene's with 768 x 496 pixels in the
same field of view and the faults that act on light. Only the light is not simulated at full size: its own noise would
be above the camera's for any number of photons that a benchmark could wait for. It is simulated at 192 x 124 and
interpolated (cubic splines), inside a silhouette of full resolution.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hw.interface import Aim

if TYPE_CHECKING:
    from disco_twin.experiment.experiment import Experiment

F32 = NDArray[np.float32]

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "quick.toml"
WIDTH, HEIGHT = 768, 496
FACTOR = 4  # the light is simulated with so many times fewer pixels per axis
SEED = 5


class Interpolated:
    """Implements `disco_twin.emulation.twin_rig.ResponseSource`: light of `coarse`, silhouettes of `fine`."""

    def __init__(self, coarse: Any, fine: Any) -> None:
        self.coarse = coarse
        self.prepare = coarse.prepare
        self.silhouette = cache(fine.silhouette)
        self._spot = cache(self._interpolated)

    def image(self, camera: int, aim: Aim, laser: int) -> F32:
        """(HEIGHT, WIDTH) radiance per watt."""
        return self._spot(camera, aim, laser)

    def _interpolated(self, camera: int, aim: Aim, laser: int) -> F32:
        light = ndimage.zoom(self.coarse.image(camera, aim, laser), FACTOR, order=3, mode="nearest", grid_mode=True)
        return np.asarray(np.maximum(light, 0.0) * (self.silhouette(camera, aim.angle) > 0), np.float32)


def capture_frames(folder: Path, spots: int, walks: int, angles: int = 3, vertices: int | None = None) -> Experiment:
    """A whole capture of `spots` spots with `walks` photons each, into `folder / "capture"`; its experiment.

    angles: of the turntable, evenly spaced; vertices: of the scan, about, if not the scene's
    """
    from disco_twin.emulation.twin_rig import TwinRig
    from disco_twin.experiment.experiment import Experiment
    from disco_twin.faults.actual_rig import actual_rig
    from disco_twin.scene.rig_schema import TwinRigConfig
    from disco_twin.scene.scene import load_scene
    from pipeline.capture.loop import capture

    scene = load_scene(SCENE, faults=False)
    lit = {"warm_up": True, "blue_noise": True, "mode_hop": True, "speckle": True, "flare": True}

    def rig(factor: int) -> TwinRigConfig:
        size = {"width": WIDTH // factor, "height": HEIGHT // factor, "pixel_pitch_um": 11.0 * factor}
        cameras = tuple(camera.model_copy(update=size) for camera in scene.rig.cameras)
        faults = scene.rig.faults.model_copy(update=lit)
        turns = tuple(360.0 * j / angles for j in range(angles))
        update = {"spots": spots, "cameras": cameras, "faults": faults, "turntable_angles_deg": turns}
        return scene.rig.model_copy(update=update)

    scan = scene.scan.model_copy(update={"vertices": vertices or scene.scan.vertices})
    experiment = Experiment(scene.model_copy(update={"rig": rig(1), "scan": scan}))
    transport = experiment.transport
    from disco_twin.light.response import SpotResponses
    from disco_twin.light.spot_walks import SpotWalks

    def responses(factor: int) -> SpotResponses:
        return SpotResponses(
            transport, rig(factor), actual_rig(rig(factor), scene.seed), SpotWalks(walks), SEED, folder / "responses"
        )

    twin = TwinRig(rig(1), Interpolated(responses(FACTOR), responses(1)), scene.seed)
    capture(twin, experiment.plan, folder / "capture")
    return experiment
