"""Calibration targets in front of the twin's cameras: chessboards and a white plate, by ray casting.

A `ResponseSource` like the object: placement number i stands where turntable angle i would. Nominal poses are what the
lab was asked for; a hand puts each mount a few millimetres and degrees beside.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from disco_twin.deviation import ActualRig, nudge
from disco_twin.faults import Stream, generator
from hw.interface import Aim
from pipeline.calibrate.camera import PinholeCamera
from pipeline.capture.targets import Targets

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

HAND_MM, HAND_DEG = 2.0, 2.0  # standard deviations per axis
FLOODLIGHT = 2e-5  # W/(mm^2 sr) of a white surface
WHITE, BLACK, SURROUNDINGS = 0.9, 0.04, 0.01
HALO_SHARE, HALO_MM = 0.15, 1.5  # light that spreads inside the plate before it leaves: exponential
SUPERSAMPLE = (
    4  # rays per pixel and axis: an edge is right to a tenth of a pixel, and far better on average over its length
)


@dataclass
class TargetSource:
    """Implements `disco_twin.rig.ResponseSource` for one camera, in the world frame; beam_radius in mm."""

    targets: Targets
    camera: PinholeCamera
    actual: ActualRig
    beam_radius: float
    _seen: tuple[int, F64, float] | None = field(default=None, init=False)

    @cached_property
    def _rays(self) -> tuple[F64, F64]:
        """(3,) position and (N, 3) directions of the refined pixels' rays in the world frame."""
        _, direction = self.camera.rays(self.camera.pixel_centres(SUPERSAMPLE))
        return self.camera.position, direction

    def prepare(self, aims: Sequence[Aim]) -> None:
        """Nothing is worth preparing."""

    def pose(self, placement: int) -> F64:
        """(4, 4) target -> world, where the target really stands."""
        p = self.targets.placements[placement]
        rng = generator(self.actual.seed, Stream.TARGETS, zlib.crc32(self.targets.camera.encode()), p.mount)
        return np.asarray(np.array(p.pose) @ nudge(rng, HAND_MM, HAND_DEG))

    def _plane(self, placement: int) -> tuple[F64, float]:
        """(N, 2) points of the target's plane behind the refined pixels in mm, and the side (sign of z) seen."""
        if self._seen is None or self._seen[0] != placement:
            pose, (position, direction) = self.pose(placement), self._rays
            o, d = pose[:3, :3].T @ (position - pose[:3, 3]), direction @ pose[:3, :3]
            self._seen = placement, (o - (o[2] / d[:, 2:]) * d)[:, :2], float(np.sign(o[2]))
        return self._seen[1], self._seen[2]

    def silhouette(self, camera: int, angle: int) -> F32:
        """(H, W) radiance in W/(mm^2 sr) under the floodlight."""
        xy, _ = self._plane(angle)
        shade = np.where(np.abs(xy).max(axis=1) < self.targets.plate_mm / 2, WHITE, SURROUNDINGS)
        if self.targets.placements[angle].kind == "board":
            cells = np.array([self.targets.columns + 1, self.targets.rows + 1])
            cell = np.floor(xy / self.targets.square_mm + cells / 2).astype(int)
            printed = ((cell >= 0) & (cell < cells)).all(axis=1)
            shade[printed & (cell.sum(axis=1) % 2 == 0)] = BLACK
        return self._pixels(shade * FLOODLIGHT)

    def image(self, camera: int, aim: Aim, laser: int) -> F32:
        """(H, W) radiance of the plate in 1/(mm^2 sr), per watt of laser power."""
        (xy, side), pose = self._plane(aim.angle), self.pose(aim.angle)
        start, way = self.actual.projector.rays(self.actual.steps(aim)[None])
        o, d = pose[:3, :3].T @ (start[0] - pose[:3, 3]), pose[:3, :3].T @ way[0]
        away = xy - (o - o[2] / d[2] * d)[:2]
        squared = (away**2).sum(axis=1)
        lit = squared - (away @ d[:2]) ** 2 < self.beam_radius**2
        spread = (1 - HALO_SHARE) * lit * abs(d[2]) / (np.pi * self.beam_radius**2)
        spread = spread + HALO_SHARE * np.exp(-np.sqrt(squared) / HALO_MM) / (2 * np.pi * HALO_MM**2)
        share = self.targets.reflected if side == np.sign(o[2]) else self.targets.transmitted
        return self._pixels(spread * share[laser] / np.pi)

    def _pixels(self, fine: F64) -> F32:
        s, camera = SUPERSAMPLE, self.camera
        return np.asarray(fine.reshape(camera.height, s, camera.width, s).mean(axis=(1, 3)), np.float32)
