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
from scipy import ndimage

from disco_twin.faults.actual_rig import ActualRig, nudge
from disco_twin.faults.light_faults import Stream, generator
from hw.base.arrays import F32, F64
from hw.interface import Aim
from pipeline.geometry.camera import PinholeCamera
from pipeline.plan.targets import Targets

HAND_MM, HAND_DEG = 2.0, 2.0  # standard deviations per axis
FLOODLIGHT = 2e-5  # W/(mm^2 sr) of a white surface
WHITE, BLACK, SURROUNDINGS = 0.9, 0.04, 0.01
HALO_SHARE, HALO_MM = 0.15, 1.5  # light that spreads inside the plate before it leaves: exponential
SUPERSAMPLE = 4  # rays per pixel and axis
EDGE_SAMPLES = 16  # the same where an edge passes: a pixel's share of either side is right to half a per cent


@dataclass
class TargetSource:
    """A `ResponseSource` of the twin for one camera, in the world frame; beam_radius in mm."""

    targets: Targets
    camera: PinholeCamera
    actual: ActualRig
    beam_radius: float
    _seen: tuple[int, F64, float] | None = field(default=None, init=False)
    _lit: tuple[Aim, F32, bool] | None = field(default=None, init=False)

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
        s, height, width = SUPERSAMPLE, self.camera.height, self.camera.width
        board = self.targets.placements[angle].kind == "board"
        fine = self._shade(xy, board).reshape(height, s, width, s)
        image = fine.mean(axis=3).mean(axis=1)
        edge = ndimage.binary_dilation(fine.max(axis=3).max(axis=1) > fine.min(axis=3).min(axis=1))
        # Inside a pixel the plane's coordinates are linear: where a pixel's own rays meet it gives all its points.
        own = xy.reshape(height, s, width, s, 2).transpose(0, 2, 1, 3, 4)[edge]  # (E, s, s, 2)
        offset = (np.arange(EDGE_SAMPLES) + 0.5) / EDGE_SAMPLES - 0.5
        reach = (s - 1) / s
        right = (own[:, :, -1].mean(axis=1) - own[:, :, 0].mean(axis=1)) / reach
        down = (own[:, -1].mean(axis=1) - own[:, 0].mean(axis=1)) / reach
        inside = own.mean(axis=(1, 2))[:, None] + offset[:, None] * right[:, None]
        points = inside[:, None] + offset[:, None, None] * down[:, None, None]
        image[edge] = self._shade(points.reshape(-1, 2), board).reshape(len(own), EDGE_SAMPLES**2).mean(axis=1)
        return np.asarray(image * FLOODLIGHT, np.float32)

    def _shade(self, xy: F64, board: bool) -> F64:
        """(N,) reflectance of (N, 2) points of the target's plane."""
        x, y = np.ascontiguousarray(xy.T)
        half, square = self.targets.plate_mm / 2, self.targets.square_mm
        shade = np.where((np.abs(x) < half) & (np.abs(y) < half), WHITE, SURROUNDINGS)
        if board:
            columns, rows = self.targets.columns + 1, self.targets.rows + 1
            i, j = np.floor(x / square + columns / 2), np.floor(y / square + rows / 2)
            printed = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
            shade[printed & ((i + j) % 2 == 0)] = BLACK
        return shade

    def image(self, camera: int, aim: Aim, laser: int) -> F32:
        """(H, W) radiance of the plate in 1/(mm^2 sr), per watt of laser power."""
        if self._lit is None or self._lit[0] != aim:  # the lasers differ in the plate's share alone
            self._lit = aim, *self._spot(aim)
        _, light, same_side = self._lit
        share = self.targets.reflected if same_side else self.targets.transmitted
        return np.asarray(light * np.float32(share[laser] / np.pi))

    def _spot(self, aim: Aim) -> tuple[F32, bool]:
        """(H, W) light that leaves the plate, 1/mm^2, if all of it did; whether the camera sees the lit side."""
        (xy, side), pose = self._plane(aim.angle), self.pose(aim.angle)
        start, way = self.actual.projector.rays(self.actual.steps(aim)[None])
        o, d = pose[:3, :3].T @ (start[0] - pose[:3, 3]), pose[:3, :3].T @ way[0]
        away = xy - (o - o[2] / d[2] * d)[:2]
        squared = (away**2).sum(axis=1)
        lit = squared - (away @ d[:2]) ** 2 < self.beam_radius**2
        spread = (1 - HALO_SHARE) * lit * abs(d[2]) / (np.pi * self.beam_radius**2)
        spread = spread + HALO_SHARE * np.exp(-np.sqrt(squared) / HALO_MM) / (2 * np.pi * HALO_MM**2)
        return self._pixels(spread), bool(side == np.sign(o[2]))

    def _pixels(self, fine: F64) -> F32:
        s, camera = SUPERSAMPLE, self.camera
        return np.asarray(fine.reshape(camera.height, s, camera.width, s).mean(axis=(1, 3)), np.float32)
