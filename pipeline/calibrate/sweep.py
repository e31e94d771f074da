"""All views of a sweep: how they follow from the cameras' poses, the turntable's axis and the errors of its angles.

Increments are taken about the current values, in one order: per camera a rotation vector and a shift along the camera's
axes, then its lens; then the axis and the angles' errors.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from hw.base.arrays import F64, Bool
from pipeline.calibrate.least_squares import Prior
from pipeline.calibrate.outline import Outline
from pipeline.geometry.camera import PinholeCamera, turn

# What the set-up keeps to, standard deviations. Silhouettes overrule all of it where they can tell.
PLACE_MM, PLACE_RAD = 20.0, np.deg2rad(10.0)  # of a camera against the object
AXIS_MM, AXIS_RAD = 1.0, np.deg2rad(0.5)  # of the turntable's axis against the object frame's z axis
ANGLE_RAD = np.deg2rad(0.1)  # of a turntable angle
LENS = 4  # focal, centre x, y, k1
HELD = 1e-7  # pixels: a lens does not follow the silhouettes


@dataclass
class Sweep:
    """The unknowns and how the views follow from them. Increments are taken about the current values."""

    lenses: list[PinholeCamera]  # per camera, object frame at the first angle
    angles: F64  # (J,) nominal, relative to the first
    axis: F64 = field(default_factory=lambda: np.zeros(4))  # tilt about x, y; shift along x, y
    errors: F64 = field(default_factory=lambda: np.zeros(0))  # (J - 1,)

    @property
    def size(self) -> int:
        return (6 + LENS) * len(self.lenses) + (4 + len(self.angles) - 1 if len(self.angles) > 1 else 0)

    def turns(self) -> list[F64]:
        """Per angle, (4, 4) object -> object at the first angle."""
        place = np.eye(4)
        place[:3, :3] = Rotation.from_rotvec([*self.axis[:2], 0]).as_matrix()
        place[:2, 3] = self.axis[2:]
        back = np.linalg.inv(place)
        return [place @ turn(a) @ back for a in self.angles + np.concatenate([[0.0], self.errors])]

    def view(self, view: int) -> PinholeCamera:
        camera, angle = divmod(view, len(self.angles))
        return self.lenses[camera].seen_from(self.turns()[angle])

    def moved(self, step: F64) -> Sweep:
        lenses = []
        for c, lens in enumerate(self.lenses):
            own = step[(6 + LENS) * c : (6 + LENS) * (c + 1)]
            pose = lens.pose.copy()
            pose[:3, :3] = Rotation.from_rotvec(own[:3]).as_matrix() @ pose[:3, :3]
            pose[:3, 3] += own[3:6]
            bent = lens.distortion + np.array([own[9], 0, 0, 0, 0])
            focal = lens.focal + own[6]
            lenses.append(replace(lens, pose=pose, focal=focal, centre=lens.centre + own[7:9], distortion=bent))
        rest = step[(6 + LENS) * len(self.lenses) :]
        if not len(rest):
            return Sweep(lenses, self.angles, self.axis, self.errors)
        return Sweep(lenses, self.angles, self.axis + rest[:4], self.errors + rest[4:])

    def jacobian(self, view: int, rim: Outline) -> F64:
        """(K, P) pixels by which the outline moves along its normals, by the increments; central differences.

        A pose moves a smooth outline only as far as it moves the surface along its own normal, which at a rim is square
        to the line of sight. A mesh's normal is so only nearly: for shifts, which it would spoil, it is made so; for
        rotations it is left, lest facets tell how far a round object has turned.
        """
        base, columns = np.zeros(self.size), []
        camera, here = view // len(self.angles), self.view(view)
        depth = rim.points @ here.pose[2, :3] + here.pose[2, 3]
        scale = here.focal.mean() / (depth * np.linalg.norm(rim.across[:, :2], axis=1))
        sight = rim.points @ here.pose[:3, :3].T + here.pose[:3, 3]
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        level = rim.across - (rim.across * sight).sum(axis=1, keepdims=True) * sight
        level /= np.linalg.norm(level, axis=1, keepdims=True)
        for k in range(self.size):
            lens = k < (6 + LENS) * len(self.lenses)
            if lens and k // (6 + LENS) != camera:
                columns.append(np.zeros(len(depth)))
                continue
            h = 1e-3 if lens and k % (6 + LENS) == 9 else 1e-2 if lens and k % (6 + LENS) > 2 else 1e-4
            base[k] = h
            ahead, behind = (self.moved(sign * base).view(view) for sign in (1, -1))
            base[k] = 0
            if lens and k % (6 + LENS) >= 6:
                moved = (ahead.project(rim.points)[0] - behind.project(rim.points)[0]) * rim.normal
                columns.append(moved.sum(axis=1) / (2 * h))
            else:
                change = (ahead.pose - behind.pose) / (2 * h)
                turned = ((rim.points @ change[:3, :3].T) * rim.across).sum(axis=1)
                columns.append(scale * (turned + level @ change[:3, 3]))
        return np.stack(columns, axis=1)


def lens_rows(sweep: Sweep) -> Bool:
    """(P,) which increments are of lenses. The boards know these better than any silhouette: they stay as they are."""
    rows = np.zeros(sweep.size, bool)
    for c in range(len(sweep.lenses)):
        rows[(6 + LENS) * c + 6 : (6 + LENS) * (c + 1)] = True
    return rows


def place_prior(sweep: Sweep, share: float = 1.0) -> Prior:
    """Of the increments that are still to come, what is known times `share`; lenses are held."""
    camera = [PLACE_RAD] * 3 + [PLACE_MM] * 3 + [HELD] * LENS
    rest = sweep.size - (6 + LENS) * len(sweep.lenses)
    table = [AXIS_RAD] * 2 + [AXIS_MM] * 2 + [ANGLE_RAD] * (rest - 4)
    sigma = np.array(camera * len(sweep.lenses) + (table if rest else []))
    mean = np.zeros(sweep.size)
    if rest:
        mean[-rest:] = -np.concatenate([sweep.axis, sweep.errors])
    return Prior.independent(mean, sigma / share)


def pose_jacobian(sweep: Sweep, view: int) -> F64:
    """(6, P) of a view's pose (rotation vector along the camera's axes, object's origin) by the increments."""
    out, step = np.zeros((6, sweep.size)), np.zeros(sweep.size)
    here = sweep.view(view).pose
    for k in range(sweep.size):
        step[k] = 1e-5
        there = sweep.moved(step).view(view).pose
        step[k] = 0
        out[:3, k] = Rotation.from_matrix(there[:3, :3] @ here[:3, :3].T).as_rotvec() / 1e-5
        out[3:, k] = (there[:3, 3] - here[:3, 3]) / 1e-5
    return out
