"""The two-mirror laser projector: mirror steps <-> rays.

Both mirrors are linear in angle. The beam is deflected by theta_x at the first mirror, travels the separation e to
the second and is deflected by theta_y there. Unfolded, in the projector's frame (z forward, second pivot at 0):
origin (e tan theta_x, 0, 0), direction (sin theta_x, cos theta_x sin theta_y, cos theta_x cos theta_y).
With e = 0 it is a pinhole, the model of thesis 5.2.3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hw.base.arrays import F64
from pipeline.geometry.camera import look_at
from pipeline.geometry.nominal_rig import ProjectorConfig


@dataclass(frozen=True)
class TwoMirrorProjector:
    """pose: (4, 4) frame -> projector; full_angle_rad: optical angle over all steps, per axis (2,)."""

    steps: int
    full_angle_rad: F64
    separation_mm: float
    pose: F64

    @classmethod
    def from_config(cls, config: ProjectorConfig) -> TwoMirrorProjector:
        """The nominal projector in the world frame. Raises: InputError where it aims at its own place."""
        angle = np.deg2rad(config.full_angle_deg)
        pose = look_at(config.position_mm, config.aim_mm, config.up)
        return cls(config.steps, np.array([angle, angle]), config.separation_mm, pose)

    def seen_from(self, frame_to_here: F64) -> TwoMirrorProjector:
        """The same projector in another frame, given the (4, 4) transform from that frame to this one."""
        return replace(self, pose=self.pose @ frame_to_here)

    def angles(self, steps: F64) -> F64:
        """(N, 2) mirror steps (u, v) -> (N, 2) optical angles in radians."""
        return np.asarray((np.asarray(steps, float) / (self.steps - 1) - 0.5) * self.full_angle_rad)

    def rays(self, steps: F64) -> tuple[F64, F64]:
        """(N, 2) mirror steps (u, v) -> (N, 3) origins and unit directions of the beam's axis in the frame."""
        tx, ty = self.angles(steps).T
        zero = np.zeros_like(tx)
        origin = np.column_stack([self.separation_mm * np.tan(tx), zero, zero])
        direction = np.column_stack([np.sin(tx), np.cos(tx) * np.sin(ty), np.cos(tx) * np.cos(ty)])
        rotation, shift = self.pose[:3, :3], self.pose[:3, 3]
        return (origin - shift) @ rotation, direction @ rotation

    def steps_to(self, points: F64) -> F64:
        """(N, 3) points of the frame -> (N, 2) mirror steps whose axis passes through them (not rounded)."""
        x, y, z = (points @ self.pose[:3, :3].T + self.pose[:3, 3]).T
        theta = np.column_stack([np.arctan2(x, np.hypot(y, z) + self.separation_mm), np.arctan2(y, z)])
        return np.asarray((theta / self.full_angle_rad + 0.5) * (self.steps - 1))
