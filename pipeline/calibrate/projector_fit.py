"""Where the projector stands, from spots whose place on the surface is known (thesis 5.2.3), and its step size.

First the projection matrix: homogeneous DLT by SVD with Hartley's normalisation, drawn many times from few spots so
that false ones do not matter. (The thesis prints 1, 2, 3 in the fourth column, which is 1, and fixes t3 = 1, singular
where t3 is near 0.) Then the two-mirror model by least squares, started from what the rig was built to be.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from hw.base.arrays import F64, I64, Bool
from hw.base.errors import DiscoError
from hw.base.outcome import Outcome, Unsolved
from pipeline.calibrate.least_squares import Huber, Prior, minimise
from pipeline.geometry.projector import TwoMirrorProjector

DRAWS, SAMPLE = 400, 8
LEAST_SPOTS = 12
FLAT = 0.02  # of the spots' extent: thinner than this they are nearly coplanar
# To which a set-up keeps a device's place (by tape measure) and direction, standard deviations; spots tell no distance.
PLACE_MM, PLACE_RAD = 1.0, np.deg2rad(0.5)
ANGLE_SHARE = 0.01  # to which the full angles are known unmeasured, standard deviation
SHIFT_MM = 1.0  # by which a spot's peak may move, per unit of a direction's sine and of its cube
HUBER = 2.0  # in units of the spots' own scatter
GATE = 5.0  # beyond this many scatters a spot is false
STEPS = 15
SETTLED = 0.01  # relative change of the spots' scatter, after so many steps, with which a fit still serves


def dlt(points: F64, steps: F64) -> F64:
    """(3, 4) projection matrix from (N, 3) mm and (N, 2) steps, N >= 6 (Hartley and Zisserman 2004, algorithm 7.1)."""
    here, there = _normaliser(points), _normaliser(steps)
    x = np.column_stack([points, np.ones(len(points))]) @ here.T
    u, v = (np.column_stack([steps, np.ones(len(steps))]) @ there.T)[:, :2].T
    none = np.zeros_like(x)
    rows = np.concatenate(
        [np.hstack([x, none, -u[:, None] * x]), np.hstack([none, x, -v[:, None] * x])]
    )  # the fourth column of a point is 1
    matrix = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 4)
    return np.asarray(np.linalg.inv(there) @ matrix @ here)


def _normaliser(points: F64) -> F64:
    """(d + 1, d + 1) similarity that brings points to mean 0 and mean distance sqrt(d)."""
    d, mean = points.shape[1], points.mean(axis=0)
    scale = np.sqrt(d) / max(float(np.linalg.norm(points - mean, axis=1).mean()), 1e-12)
    out = np.eye(d + 1)
    out[:d, :d] *= scale
    out[:d, d] = -scale * mean
    return out


def true_spots(points: F64, steps: F64, tolerance: float, rng: np.random.Generator) -> Bool:
    """(N,) spots that one projection matrix fits, by robust DLT; `tolerance` in steps separates them from false ones.

    Raises: DiscoError where too few spots agree, nearly coplanar ones do, or one is not finite.
    """
    if not (np.isfinite(points).all() and np.isfinite(steps).all()):
        raise Unsolved("the search for the projector's spots", Outcome.OUT_OF_RANGE)
    require_depth(points)
    best: Bool = np.zeros(len(points), bool)
    for _ in range(DRAWS):
        some = rng.choice(len(points), SAMPLE, replace=False)
        good = _misses(dlt(points[some], steps[some]), points, steps) < tolerance
        if good.sum() > best.sum():
            best = good
    for _ in range(3):
        if best.sum() < LEAST_SPOTS:
            raise DiscoError(
                f"only {int(best.sum())} of {len(points)} spots agree on a projector, {LEAST_SPOTS} are needed. "
                "Remedy: check the object's pose and the mirrors' directions"
            )
        require_depth(points[best])
        best = _misses(dlt(points[best], steps[best]), points, steps) < tolerance
    return best


def require_depth(points: F64) -> None:
    """Raises: DiscoError for spots from which the projector's distance does not follow: few, or nearly coplanar."""
    if len(points) < LEAST_SPOTS:
        raise DiscoError(
            f"{len(points)} spots were seen by a camera, {LEAST_SPOTS} are needed to find the projector. "
            "Remedy: capture more spots (rig.spots of the scene)"
        )
    extent = np.sqrt(np.linalg.eigvalsh(np.cov(points.T)))
    if extent[0] < FLAT * extent[2]:
        raise DiscoError(
            f"the spots are nearly coplanar ({extent[0]:.3g} mm thick, {extent[2]:.3g} mm wide, standard deviations): "
            "the projector's distance cannot be told from them. Remedy: light an object with more relief, or turn it "
            "to light more sides of it"
        )


def _misses(matrix: F64, points: F64, steps: F64) -> F64:
    """(N,) steps; matrix: (3, 4), homogeneous (x, y, z, 1) in mm -> steps."""
    u, v, w = (np.column_stack([points, np.ones(len(points))]) @ matrix.T).T
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.linalg.norm(np.column_stack([u / w, v / w]) - steps, axis=1)
    return np.asarray(np.where(np.isfinite(away), away, np.inf))


@dataclass(frozen=True)
class StepSize:
    """full_angle_rad: (2,) over all steps; covariance: (2, 2), rad^2, if the projector stands where it was taken to.

    by_pose: (2, 6) what a change of the projector's pose (as in `ProjectorFit`) would change of them: the plane is seen
    from the projector only by way of its pose, whose error the fit shares
    """

    full_angle_rad: F64
    covariance: F64
    by_pose: F64 = field(default_factory=lambda: np.zeros((2, 6)))


def step_size(points: F64, steps: F64, motion: F64, projector: TwoMirrorProjector, noise: float) -> StepSize:
    """The plane measurement (thesis figure 5.2). points: (N, 3) mm on the plane, projector's frame.

    motion: (6, 6) covariance of the plane's place there: rotation about the object's origin (rad), and shift (mm). A
    step of angle moves the spot by step * (distance + separation) along the first mirror's direction, for that mirror
    stands further back: the thesis's 2 arctan(a / d) is too large by separation / d there.
    """
    full, spread = _full_angles(points, steps, projector, noise)
    pivot, by_pose = projector.pose[:3, 3], np.empty((2, 6))
    for k in range(6):
        h = np.zeros(6)
        h[k] = 1e-4 if k < 3 else 1e-2
        ends = [Rotation.from_rotvec(s * h[:3]).apply(points - pivot) + pivot + s * h[3:] for s in (1, -1)]
        ahead, behind = (_full_angles(end, steps, projector, noise)[0] for end in ends)
        by_pose[:, k] = (ahead - behind) / (2 * h[k])
    return StepSize(full, np.diag(spread**2) + by_pose @ motion @ by_pose.T, by_pose)


def _full_angles(points: F64, steps: F64, projector: TwoMirrorProjector, noise: float) -> tuple[F64, F64]:
    """(2,) full angles from spots on the plane, and what the spots' noise (mm) makes of them."""
    angle, distance = projector.angles(steps), points[:, 2]
    tangent = np.column_stack([np.tan(angle[:, 0]), np.tan(angle[:, 1])])
    # Unfolded: x = (e + sqrt(y^2 + z^2)) tan(theta_x), y = z tan(theta_y).
    reach = np.column_stack([projector.separation_mm + distance * np.hypot(1.0, tangent[:, 1]), distance])
    full, spread = np.empty(2), np.empty(2)
    for k in (0, 1):
        design = np.column_stack([reach[:, k] * tangent[:, k], np.ones(len(points))])
        (slope, _), *_ = np.linalg.lstsq(design, points[:, k], rcond=None)
        full[k] = projector.full_angle_rad[k] * slope
        spread[k] = projector.full_angle_rad[k] * noise / np.sqrt(((design[:, 0] - design[:, 0].mean()) ** 2).sum())
    return full, spread


@dataclass(frozen=True)
class ProjectorFit:
    """covariance: (8, 8) of the pose (rotation of the object about its origin, along the projector's axes, rad; the
    origin in the projector's frame, mm) and of the two full angles (rad)

    rms_mm: of the true spots across the beam; false: (N,) spots left out

    shift: (2,) mm by which a spot's peak moves along the light's way and, by reciprocity, towards the eye (Godin et al.
    2001): per unit of the direction's tangential part, and of its cube; and its standard deviations
    images, sightings: how many were looked at, and how many of them show the spot itself
    """

    projector: TwoMirrorProjector
    covariance: F64
    rms_mm: float
    false: Bool
    shift: F64
    shift_error: F64
    images: int = 0
    sightings: int = 0

    def misses(self, points: F64, steps: F64, normals: F64, to_eye: F64) -> F64:
        """(N, 2) mm from the beam's axis to spots, across it."""
        value = np.concatenate([np.zeros(6), self.projector.full_angle_rad, self.shift])
        return _across(self.projector, value, points, steps, normals, to_eye)


def refine(
    start: TwoMirrorProjector,
    points: F64,
    steps: F64,
    normals: F64,
    to_eye: F64,
    size: StepSize | None = None,
    group: I64 | None = None,
    place: F64 | None = None,
) -> ProjectorFit:
    """Two-mirror model by robust least squares on what the beam's axis misses the spots by, across the beam, in mm.

    start: the nominal projector, points: (N, 3) mm, all in one frame; normals, to_eye: (N, 3) unit; group: (N,) spots
    of one group err together (default: each for itself); place: (6, 6) covariance of the nominal pose (default: of a
    projector set up in the points' own frame). Raises: Unsolved as `minimise`, and where it does not converge.
    """
    nominal = start.full_angle_rad
    known = StepSize(nominal, np.diag((nominal * ANGLE_SHARE) ** 2)) if size is None else size
    prior = _prior(own_place(start.pose) if place is None else place, known)
    group = np.arange(len(points)) if group is None else group

    def misses(unit: float, value: F64) -> F64:
        return _across(start, value, points, steps, normals, to_eye).ravel() / unit

    value, scatter = np.concatenate([np.zeros(6), nominal, [0.0, 0.0]]), np.inf
    loss = Huber(HUBER, GATE, width=2)  # of misses in units of their scatter
    for _ in range(STEPS):
        before, scatter = scatter, max(float(np.median(loss.size(misses(1.0, value)))) / 1.1774, 1e-4)
        fit = minimise(partial(misses, scatter), value, prior, loss=loss)
        value = fit.value
        if abs(scatter - before) < 1e-4 * scatter:
            break
    else:
        if abs(scatter - before) > SETTLED * scatter:
            raise Unsolved("the projector's fit", Outcome.STOPPED, STEPS)
    fit.ended.require("the projector's fit")
    inverse = fit.covariance
    covariance = inverse @ (fit.scatter(np.repeat(group, 2)) + prior.precision) @ inverse
    kept = fit.weight[::2] > 0
    return ProjectorFit(
        _moved(start, value),
        covariance[:8, :8],
        scatter * float(np.sqrt((loss.size(fit.residual)[kept] ** 2).mean())) if kept.any() else np.inf,
        ~kept,
        value[8:],
        np.sqrt(np.diag(covariance)[8:]),
    )


def own_place(pose: F64) -> F64:
    """(6, 6) covariance of a (4, 4) frame -> device pose: rotation about the frame's origin (rad) and that origin (mm).

    The device is off by a rotation r about itself and a shift t; the frame's origin at x moves by r x x + t.
    """
    x, y, z = pose[:3, 3]
    lever = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0.0]])
    along = np.vstack([np.eye(3), lever]) * PLACE_RAD
    out = along @ along.T
    out[3:, 3:] += PLACE_MM**2 * np.eye(3)
    return np.asarray(out)


def _prior(place: F64, size: StepSize) -> Prior:
    """Of the ten unknowns before any spot is seen: pose, full angles, the peak's shift."""
    precision = np.zeros((10, 10))
    precision[:6, :6] = np.linalg.inv(place)
    precision[8:, 8:] = SHIFT_MM**-2 * np.eye(2)
    # A pose that is off by p gives the plane's angles off by -by_pose p.
    rows = np.hstack([-size.by_pose, np.eye(2), np.zeros((2, 2))])
    precision += rows.T @ np.linalg.inv(size.covariance) @ rows
    return Prior(np.concatenate([np.zeros(6), size.full_angle_rad, [0.0, 0.0]]), precision)


def _moved(start: TwoMirrorProjector, value: F64) -> TwoMirrorProjector:
    pose = start.pose.copy()
    pose[:3, :3] = Rotation.from_rotvec(value[:3]).as_matrix() @ pose[:3, :3]
    pose[:3, 3] += value[3:6]
    return replace(start, pose=pose, full_angle_rad=value[6:8])


def _across(start: TwoMirrorProjector, value: F64, points: F64, steps: F64, normals: F64, to_eye: F64) -> F64:
    """(N, 2) mm from the beam's axis to the spots, in two fixed directions across it; the peak's shift is taken off."""
    projector = _moved(start, value)
    origin, way = projector.rays(steps)
    true = points - _peak_shift(value[8:], way, normals) - _peak_shift(value[8:], to_eye, normals)
    right, down = projector.pose[0, :3], projector.pose[1, :3]
    away = true - origin
    away = away - (away * way).sum(axis=1, keepdims=True) * way
    return np.column_stack([away @ right, away @ down])


def _peak_shift(shift: F64, direction: F64, normals: F64) -> F64:
    """(N, 3) mm."""
    tangential = direction - (direction * normals).sum(axis=1, keepdims=True) * normals
    return np.asarray((shift[0] + shift[1] * (tangential**2).sum(axis=1, keepdims=True)) * tangential)
