"""The actual rig: the nominal one, off by what a careful set-up on an optical table is off by.

The pipeline is given the nominal rig only. Without `faults.deviation` the actual rig is the nominal one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from disco_twin.faults.light_faults import Stream, generator
from disco_twin.scene.rig_schema import TwinRigConfig
from hw.base.arrays import F64
from hw.interface import Aim
from pipeline.geometry.camera import PinholeCamera, turn
from pipeline.geometry.projector import TwoMirrorProjector

# Standard deviations.
CAMERA_MM, CAMERA_DEG = 1.0, 0.2
FOCAL_SHARE, CENTRE_SHARE, RADIAL_K1 = 0.003, 0.005, 0.05  # of the focal length; of the width; of OpenCV's k1
PROJECTOR_MM, PROJECTOR_DEG, MIRROR_ANGLE_SHARE = 1.0, 0.1, 0.003
TURNTABLE_MM, TURNTABLE_TILT_DEG, TURNTABLE_DEG = 0.1, 0.05, 0.05
MIRROR_STEPS = 0.5  # error of each move, per mirror
RESPONSE_SHARE, PHOTODIODE_SHARE = 0.03, 0.03  # of the responsivities that the data sheets state


@dataclass(frozen=True)
class ActualRig:
    """cameras, projector: in the world frame; turns: per turntable angle, (4, 4) object -> world.

    mirror_steps: standard deviation of the mirrors' error; the error of an aim depends on `seed` and the aim alone.
    response: (C, L) what a camera shows of a laser's light, and photodiode: (L,) what the photodiode reads of its
    power, both relative to the data sheets.
    """

    cameras: tuple[PinholeCamera, ...]
    projector: TwoMirrorProjector
    turns: tuple[F64, ...]
    mirror_steps: float
    seed: int
    response: F64
    photodiode: F64

    def camera(self, camera: int, angle: int) -> PinholeCamera:
        """A camera in the object frame, at a turntable angle (index)."""
        return self.cameras[camera].seen_from(self.turns[angle])

    def steps(self, aim: Aim) -> F64:
        """(2,) where the mirrors really stand, in steps."""
        nominal = np.array([aim.u, aim.v], float)
        if self.mirror_steps == 0:
            return nominal
        rng = generator(self.seed, Stream.MIRRORS, aim.angle, aim.u, aim.v)
        return nominal + self.mirror_steps * rng.standard_normal(2)

    def spot_rays(self, aims: Sequence[Aim]) -> tuple[F64, F64]:
        """(S, 3) origins in mm and (S, 3) unit directions of the beams' axes in the object frame."""
        origins, directions = np.empty((len(aims), 3)), np.empty((len(aims), 3))
        for i, aim in enumerate(aims):
            rays = self.projector.seen_from(self.turns[aim.angle]).rays(self.steps(aim)[None])
            origins[i], directions[i] = rays[0][0], rays[1][0]
        return origins, directions


def actual_rig(config: TwinRigConfig, seed: int) -> ActualRig:
    """The rig that the light goes through. It does not depend on the order of anything but the seed."""
    cameras = tuple(PinholeCamera.from_config(c) for c in config.cameras)
    projector = TwoMirrorProjector.from_config(config.projector)
    turns = [turn(np.deg2rad(a)) for a in config.turntable_angles_deg]
    response, photodiode = np.ones((len(cameras), len(config.lasers))), np.ones(len(config.lasers))
    if not config.faults.deviation:
        return ActualRig(cameras, projector, tuple(turns), 0.0, seed, response, photodiode)
    cameras = tuple(_off(c, generator(seed, Stream.DEVIATION, 1, i)) for i, c in enumerate(cameras))
    rng = generator(seed, Stream.DEVIATION, 2)
    projector = replace(
        projector,
        pose=nudge(rng, PROJECTOR_MM, PROJECTOR_DEG) @ projector.pose,
        full_angle_rad=projector.full_angle_rad * (1 + MIRROR_ANGLE_SHARE * rng.standard_normal(2)),
    )
    rng = generator(seed, Stream.DEVIATION, 3)
    axis = nudge(rng, TURNTABLE_MM, TURNTABLE_TILT_DEG)
    errors = np.deg2rad(TURNTABLE_DEG) * rng.standard_normal(len(turns))
    turns = [axis @ at @ turn(error) @ np.linalg.inv(axis) for at, error in zip(turns, errors, strict=True)]
    rng = generator(seed, Stream.DEVIATION, 4)
    response = response * (1 + RESPONSE_SHARE * rng.standard_normal(response.shape))
    photodiode = photodiode * (1 + PHOTODIODE_SHARE * rng.standard_normal(photodiode.shape))
    return ActualRig(cameras, projector, tuple(turns), MIRROR_STEPS, seed, response, photodiode)


def nudge(rng: Generator, length_mm: float, angle_deg: float) -> F64:
    """(4, 4) small rigid motion: normal shift per axis, normal rotation vector."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(np.deg2rad(angle_deg) * rng.standard_normal(3)).as_matrix()
    motion[:3, 3] = length_mm * rng.standard_normal(3)
    return motion


def _off(camera: PinholeCamera, rng: Generator) -> PinholeCamera:
    """The camera as it stands on its tripod, with the lens that it has."""
    return replace(
        camera,
        pose=nudge(rng, CAMERA_MM, CAMERA_DEG) @ camera.pose,
        focal=camera.focal * (1 + FOCAL_SHARE * rng.standard_normal()),
        centre=camera.centre + CENTRE_SHARE * camera.width * rng.standard_normal(2),
        distortion=camera.distortion + RADIAL_K1 * np.array([rng.standard_normal(), 0, 0, 0, 0]),
    )
