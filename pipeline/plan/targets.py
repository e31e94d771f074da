"""What a lab photographs to calibrate a rig, and in what order: boards in many poses, a white plate under each laser.

The targets stand where the object will stand, put there by hand near a nominal pose. Cameras are calibrated one by one.
A camera's capture is a stream like any other, whose plan counts *placements* instead of turntable angles: in each a
floodlit image, then the placement's spots in every laser. `targets.json` beside it says what stands in each placement.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from hw.base.arrays import F64
from hw.base.config import Strict
from hw.interface import Aim
from pipeline.geometry.camera import PinholeCamera, Pose, look_at, pose_rows
from pipeline.geometry.nominal_rig import CameraConfig, RigConfig
from pipeline.geometry.projector import TwoMirrorProjector
from pipeline.plan.plan import Plan

TARGETS = "targets.json"
FOLDER = "calibration"  # in the capture's folder
BRACKET = "bracket"  # in a camera's folder there: exposures of a board, where the camera is not linear

BOARDS = 24  # 12 know the focal length to .06 %, but in a lab some are lost
TILT_DEG = 45.0  # of most boards: perspective, and with it the focal length, shows in tilted planes only
SQUARES_IN_VIEW = 16.0  # across the image's width
SERIES = 6  # exposures of the white plate per laser and placement
PLANE_GRID = 4  # spots per axis on the white plate: the projector's step size
FIELD = 0.6  # of the image's width and height that a plate's spots may fill


class Placement(Strict):
    """A target at a place. `mount`: placements of one mount stand in the very same place, though nobody knows where.

    pose: nominal (4, 4) target -> world; the target's plane is z = 0
    """

    kind: Literal["board", "white"]
    mount: Annotated[int, Field(ge=0)]
    pose: Pose


class Targets(Strict):
    """One camera's placements. columns, rows: inner corners of the board, centred, printed on both sides.

    reflected, transmitted: shares of the power that the white plate scatters to the lit and to the far side, by laser
    """

    format_version: Literal[1] = 1
    camera: str
    columns: Annotated[int, Field(ge=3)] = 11
    rows: Annotated[int, Field(ge=3)] = 6
    square_mm: Annotated[float, Field(gt=0)]
    plate_mm: Annotated[float, Field(gt=0)]
    reflected: tuple[float, ...]
    transmitted: tuple[float, ...]
    placements: Annotated[tuple[Placement, ...], Field(min_length=1)]

    def corners(self) -> F64:
        """(rows * columns, 3) inner corners in mm, row by row, in the target's plane."""
        x, y = np.arange(self.columns) - (self.columns - 1) / 2, np.arange(self.rows) - (self.rows - 1) / 2
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) * self.square_mm
        return np.column_stack([grid, np.zeros(len(grid))])


def make_targets(rig: RigConfig, camera: int) -> tuple[Targets, Plan]:
    """The targets for a camera of a nominal rig, and the plan of their images.

    The white plate comes first, while the lasers are cold, and last: the photodiode is followed over the whole time.
    """
    config = rig.cameras[camera]
    placements = []
    for mount in (0, 1):
        pose = pose_rows(_plate_pose(rig, config, float(mount)))
        placements += [Placement(kind=kind, mount=mount, pose=pose) for kind in ("white", "board")]
    for k in range(BOARDS):
        placements.append(Placement(kind="board", mount=2 + k, pose=pose_rows(_board_pose(config, k))))
    placements.append(placements[2])
    targets = Targets(
        camera=config.name,
        square_mm=width_mm(config) / SQUARES_IN_VIEW,
        plate_mm=2.0 * width_mm(config),
        reflected=(0.5,) * len(rig.lasers),
        transmitted=(0.4,) * len(rig.lasers),
        placements=tuple(placements),
    )
    lit = [(i, p) for i, p in enumerate(placements) if p.kind == "white"]
    spots = tuple(aim for i, p in lit for aim in _plate_aims(rig, config, np.array(p.pose), i))
    return targets, _plan(targets, spots, rig)


def make_bracket(rig: RigConfig, camera: int) -> tuple[Targets, Plan]:
    """A board under the floodlight, once for each exposure: its white, its black and the greys along their borders."""
    config, (targets, _) = rig.cameras[camera], make_targets(rig, camera)
    board = Placement(kind="board", mount=2, pose=pose_rows(_board_pose(config, 3)))
    still = targets.model_copy(update={"placements": (board,) * rig.sensor.steps})
    return still, _plan(still, (), rig)


def _plan(targets: Targets, spots: tuple[Aim, ...], rig: RigConfig) -> Plan:
    """One camera's images, placement by placement: `angles_rad` holds the placements' numbers, which are no angles."""
    return Plan((targets.camera,), tuple(map(float, range(len(targets.placements)))), spots, len(rig.lasers))


def width_mm(config: CameraConfig) -> float:
    """Width of what a camera sees at its aim."""
    distance = float(np.linalg.norm(np.subtract(config.position_mm, config.aim_mm)))
    return distance * config.width * config.pixel_pitch_um * 1e-3 / config.focal_length_mm


def _board_pose(config: CameraConfig, k: int) -> F64:
    """(4, 4) target -> world: faces the camera, tilted about directions all around, nearer and farther, off centre."""
    turned = 2.399963 * k  # the golden angle: no two boards tilt alike
    tilt = np.deg2rad(TILT_DEG if k % 4 else 10.0)
    size = width_mm(config)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(tilt * np.array([np.cos(turned), np.sin(turned), 0.0])).as_matrix()
    distance = float(np.linalg.norm(np.subtract(config.position_mm, config.aim_mm)))
    away = 0.05 * size * np.array([np.cos(2 * turned), 0.5 * np.sin(2 * turned)])
    pose[:3, 3] = [*away, distance * (1.0 + 0.06 * (k % 3))]
    return np.asarray(np.linalg.inv(look_at(config.position_mm, config.aim_mm, config.up)) @ pose)


def _plate_pose(rig: RigConfig, config: CameraConfig, shift: float) -> F64:
    """(4, 4) target -> world: lit by the projector and seen by the camera at equal angles, from one side or both.

    `shift` in quarters of the view's width towards the projector.
    """
    aim = np.array(config.aim_mm)
    to_laser, to_camera = np.subtract(rig.projector.position_mm, aim), np.subtract(config.position_mm, aim)
    to_laser, to_camera = to_laser / np.linalg.norm(to_laser), to_camera / np.linalg.norm(to_camera)
    normal = to_laser + (to_camera if to_laser @ to_camera >= 0 else -to_camera)
    pose = np.linalg.inv(look_at(aim, aim + normal, config.up))
    pose[:3, 3] = aim + 0.25 * shift * width_mm(config) * to_laser
    return np.asarray(pose)


def _plate_aims(rig: RigConfig, config: CameraConfig, pose: F64, index: int) -> list[Aim]:
    """A series near the middle, then a grid over what the camera sees of the plate."""
    camera, projector = PinholeCamera.from_config(config), TwoMirrorProjector.from_config(rig.projector)
    middle = np.rint(projector.steps_to(pose[None, :3, 3])[0]).astype(int)
    last = projector.steps - 1
    series = [Aim(index, int(np.clip(middle[0] + k, 0, last)), int(middle[1])) for k in range(SERIES)]
    edge = FIELD / 2 * np.array([camera.width, camera.height])
    corners = camera.centre + edge * np.array([(-1, 0), (1, 0), (0, -1), (0, 1)])
    origin, direction = camera.rays(corners)
    along = ((pose[:3, 3] - origin) @ pose[:3, 2]) / (direction @ pose[:3, 2])
    reach = projector.steps_to(origin + along[:, None] * direction)
    low, high = np.clip(reach.min(axis=0), 0, last), np.clip(reach.max(axis=0), 0, last)
    centre, half = (low + high) / 2, (high - low) / 2 * 0.75
    u, v = (np.rint(np.linspace(centre[k] - half[k], centre[k] + half[k], PLANE_GRID)).astype(int) for k in (0, 1))
    return series + [Aim(index, int(a), int(b)) for a in u for b in v]
