"""A small rig, its plan and a response source: what captures by the twin are tested with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from disco_twin.scene.rig_schema import FaultsConfig, TwinRigConfig
from hw.interface import Aim
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.plan.plan import Plan

CAMERAS = tuple(
    CameraConfig(name=name, position_mm=(x, 60, 100), width=48, height=31, focal_length_mm=10)
    for name, x in (("front", 450), ("back", -450))
)


FAULTS = FaultsConfig(deviation=True, warm_up=True, blue_noise=True, mode_hop=True, speckle=True, flare=True)


RIG = TwinRigConfig(cameras=CAMERAS, turntable_angles_deg=(0, 180), faults=FAULTS)


PLAN = Plan(
    ("front", "back"), (0.0, float(np.pi)), (Aim(0, 1900, 2000), Aim(0, 2100, 2000), Aim(1, 2048, 1950)), lasers=3
)


class Glow:
    """A response source: an exponential spot. Fails at one image if asked to."""

    def __init__(self, fail_at: int = -1) -> None:
        self.left = fail_at

    def prepare(self, aims: Sequence[Aim]) -> None:
        assert aims

    def image(self, camera: int, aim: Aim, laser: int) -> NDArray[np.float32]:
        self._count()
        row, column = np.mgrid[:31, :48]
        distance = np.hypot(row - 15, column - 24 - (aim.u - 2048) / 20)
        return (0.03 * np.exp(-distance / (2 + laser + camera))).astype(np.float32)

    def silhouette(self, camera: int, angle: int) -> NDArray[np.float32]:
        self._count()
        return np.full((31, 48), 1e-6, np.float32)

    def _count(self) -> None:
        if self.left == 0:
            raise RuntimeError("out of light")
        self.left -= 1
