"""Capture loop and simulated rig together: every drift on, and a resumed capture is still the same bytes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from capture_fakes import contents
from numpy.typing import NDArray

from disco_twin.rig import TwinRig
from hw.interface import Aim
from pipeline.capture.loop import capture
from pipeline.capture.plan import Plan
from pipeline.rig import CameraConfig, FaultsConfig, RigConfig

CAMERAS = tuple(
    CameraConfig(name=name, position_mm=(x, 60, 100), width=48, height=31, focal_length_mm=10)
    for name, x in (("front", 450), ("back", -450))
)
FAULTS = FaultsConfig(deviation=True, warm_up=True, blue_noise=True, mode_hop=True, speckle=True, flare=True)
RIG = RigConfig(cameras=CAMERAS, turntable_angles_deg=(0, 180), faults=FAULTS)
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


@pytest.mark.parametrize("fail_at", [0, 1, 3, 7, 8, 11, 12, 21])
def test_resumed_capture_equals_the_uninterrupted_one(tmp_path: Path, fail_at: int) -> None:
    """Also across a change of view (11 images are one camera) and within a spot."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    capture(TwinRig(RIG, Glow(), seed=5), PLAN, whole)
    with pytest.raises(RuntimeError, match="out of light"):
        capture(TwinRig(RIG, Glow(fail_at), seed=5), PLAN, parts)
    assert capture(TwinRig(RIG, Glow(), seed=5), PLAN, parts).resumed_at == fail_at
    assert contents(parts) == contents(whole)
