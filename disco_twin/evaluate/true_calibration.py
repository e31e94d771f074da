"""The calibration with parts of it made true: what the error budget replaces, and what figures of stages compare with.

Poses and projector are measured in one frame at each turntable angle, that of the scan as its silhouettes were
understood, which stands turned against the object. Where one of the two is made true, the other keeps its relation to
the cameras: otherwise beams and images would not meet on the object, which is no error of either. The scan's surface
stays as it was fitted: what an exact one would gain is a row of the budget's own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from disco_twin.camera.lens import Glare
from disco_twin.faults.actual_rig import ActualRig
from disco_twin.scene.rig_schema import TwinRigConfig
from hw.base.arrays import F64
from pipeline.calibrate.calibration import Calibration, ProjectorCalibration, pair
from pipeline.geometry.camera import pose_rows

PHOTOMETRIC, POSE, PROJECTOR, ALL = "true photometric", "true pose", "true projector", "all true"


def true_calibration(rig: TwinRigConfig, actual: ActualRig, nominal: Calibration) -> Calibration:
    """The calibration that a measurement without error would give. Each mirror move's own error stays out of reach.

    A lens that throws light outside the image is a little darker: all images lose the same share.
    """
    views = []
    for v, view in enumerate(nominal.views):
        camera, angle = divmod(v, nominal.n_angles)
        lens = actual.camera(camera, angle)
        kept = Glare.of(lens.height, lens.width).kept() if rig.faults.flare else 1.0
        views.append(
            view.model_copy(
                update={
                    "focal_px": pair(lens.focal),
                    "centre_px": pair(lens.centre),
                    "distortion": tuple(float(x) for x in lens.distortion),
                    "object_to_camera": pose_rows(lens.pose),
                    "radiance_factor": tuple(float(x) for x in actual.photodiode / (kept * actual.response[camera])),
                }
            )
        )
    projectors = [
        p.model_copy(
            update={
                "full_angle_rad": pair(actual.projector.full_angle_rad),
                "object_to_projector": pose_rows(actual.projector.seen_from(actual.turns[j]).pose),
            }
        )
        for j, p in enumerate(nominal.projectors)
    ]
    return nominal.model_copy(update={"source": "measured", "views": tuple(views), "projectors": tuple(projectors)})


def _photometric(own: Calibration, true: Calibration) -> Calibration:
    pairs = zip(own.views, true.views, strict=True)
    views = tuple(v.model_copy(update={"radiance_factor": t.radiance_factor}) for v, t in pairs)
    return own.model_copy(update={"views": views})


def _pose(own: Calibration, true: Calibration) -> Calibration:
    pairs = zip(own.views, true.views, strict=True)
    views = tuple(t.model_copy(update={"radiance_factor": v.radiance_factor}) for v, t in pairs)
    return own.model_copy(update={"views": views, "projectors": _seen_from(own.projectors, object_frames(true, own))})


def _projector(own: Calibration, true: Calibration) -> Calibration:
    return own.model_copy(update={"projectors": _seen_from(true.projectors, object_frames(own, true))})


def object_frames(here: Calibration, there: Calibration) -> list[F64]:
    """Per turntable angle, (4, 4) one calibration's object frame -> another's: a rotation, the mean of the views."""
    frames = []
    for j in range(here.n_angles):
        a, b = ([np.array(c.views[v].object_to_camera)[:3, :3] for v in c.views_at(j)] for c in (here, there))
        turned = np.eye(4)
        turned[:3, :3] = Rotation.from_matrix([y.T @ x for x, y in zip(a, b, strict=True)]).mean().as_matrix()
        frames.append(turned)
    return frames


def _seen_from(projectors: Sequence[ProjectorCalibration], frames: Sequence[F64]) -> tuple[ProjectorCalibration, ...]:
    """The projectors in other frames, given the (4, 4) transform from each to theirs."""
    poses = [pose_rows(np.array(p.object_to_projector) @ f) for p, f in zip(projectors, frames, strict=True)]
    return tuple(p.model_copy(update={"object_to_projector": x}) for p, x in zip(projectors, poses, strict=True))


# By name: (as measured, true) -> the calibration with that part made true.
VARIANTS: dict[str, Callable[[Calibration, Calibration], Calibration]] = {
    PHOTOMETRIC: _photometric,
    POSE: _pose,
    PROJECTOR: _projector,
    ALL: lambda own, true: true.model_copy(update={"scan": own.scan}),
}
