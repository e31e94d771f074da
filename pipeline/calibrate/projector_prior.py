"""Where the projector should stand before it is measured: against the cameras, which the found poses place.

The found poses' frame is the scan's own and may stand centimetres and ten degrees off the rig's (`pose.PLACE_MM`); how
the projector stands against the cameras does not depend on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from hw.base.arrays import F64
from pipeline.calibrate.pose import PoseFit
from pipeline.calibrate.projector_fit import ProjectorFit, own_place
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.nominal_rig import RigConfig
from pipeline.geometry.projector import TwoMirrorProjector


def nominal_projector(
    rig: RigConfig, cameras: Sequence[PinholeCamera], poses: PoseFit
) -> tuple[TwoMirrorProjector, F64]:
    """In the object frame at the first angle, as the cameras were found there; (6, 6) covariance of its pose."""
    first = range(0, len(poses.views), len(poses.turns))
    nominal, found = TwoMirrorProjector.from_config(rig.projector), [poses.views[v] for v in first]
    return against_cameras(nominal, cameras, found, [poses.covariance(v) for v in first])


def against_cameras(
    nominal: TwoMirrorProjector, cameras: Sequence[PinholeCamera], found: Sequence[PinholeCamera], errors: Sequence[F64]
) -> tuple[TwoMirrorProjector, F64]:
    """The projector in the found poses' frame, mean over the cameras, and the (6, 6) covariance of its pose.

    nominal, cameras: one frame; found: the same cameras in the object's frame, errors: (6, 6) of their poses. What the
    scan does to one camera's pose it does to all: these errors do not average out, those of the set-up do.
    """
    poses, total = [], own_place(nominal.pose)
    for camera, here, error in zip(cameras, found, errors, strict=True):
        to_projector = nominal.pose @ np.linalg.inv(camera.pose)
        poses.append(to_projector @ here.pose)
        turned = block_diag(to_projector[:3, :3], to_projector[:3, :3])
        total = total + turned @ (own_place(camera.pose) / len(cameras) + error) @ turned.T / len(cameras)
    pose = np.mean(poses, axis=0)
    pose[:3, :3] = Rotation.from_matrix([p[:3, :3] for p in poses]).mean().as_matrix()
    return replace(nominal, pose=pose), np.asarray(total)


def with_pose_error(fit: ProjectorFit, poses: PoseFit, view: int) -> ProjectorFit:
    """The same with what its residuals cannot show: the object's pose before the camera that saw most spots.

    Only what moves the object in the image: along the line of sight, spots stay where they were seen.
    """
    to_projector = fit.projector.pose[:3, :3] @ poses.views[view].pose[:3, :3].T
    across = block_diag(to_projector, to_projector @ np.diag([1.0, 1.0, 0.0]))
    covariance = fit.covariance.copy()
    covariance[:6, :6] += across @ poses.image_covariance[view] @ across.T
    return replace(fit, covariance=covariance)
