"""Where the object stands before each camera, from silhouettes (thesis 5.2.2), all views of a sweep together.

Unknown are each camera's pose at the first turntable angle, the turntable's axis and the angles' small errors; what the
boards left open of each camera's lens is carried into the poses' uncertainty. A coarse stage walks down the distance to
the photographed silhouette from centimetres and ten degrees away, a fine one fits edges to a few hundredths of a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from hw.base.arrays import F64, I64, Bool
from hw.base.errors import DiscoError
from pipeline.calibrate.least_squares import Huber, Linearised, Prior
from pipeline.calibrate.outline import Outline, edges_along, mesh_mask, object_mask, outline, signed_distance, synthetic
from pipeline.calibrate.scan_error import surface_error
from pipeline.geometry.camera import PinholeCamera, turn

# What the set-up keeps to, standard deviations. Silhouettes overrule all of it where they can tell.
PLACE_MM, PLACE_RAD = 20.0, np.deg2rad(10.0)  # of a camera against the object
AXIS_MM, AXIS_RAD = 1.0, np.deg2rad(0.5)  # of the turntable's axis against the object frame's z axis
ANGLE_RAD = np.deg2rad(0.1)  # of a turntable angle
UNDETERMINED_RAD, UNDETERMINED_MM = np.deg2rad(1.0), 5.0  # a direction that is known no better is stated as open
COARSE_STEPS, FINE_STEPS, EXACT_STEPS = 25, 5, 2
HUBER_COARSE_PX, HUBER_FINE_PX = 3.0, 0.15
SECTORS = 24  # per view: errors of the edges within one are taken as dependent
COMMON_EDGE_PX = 0.003  # edges of a camera may be off together by this
LENS = 4  # focal, centre x, y, k1
HELD = 1e-7  # pixels: a lens does not follow the silhouettes


@dataclass(frozen=True)
class PoseFit:
    """views: per view, camera in the object frame; turns: per angle, (4, 4) object -> object at the first angle.

    rotation, translation: (V, 3) standard deviations of each view's pose: of the object about its own origin, in rad
    along the camera's axes, and of the origin, mm; residual_px: root mean square of the edges; edges: their number
    image_covariance: (V, 6, 6) the same rotation and translation as far as they move the object in the image, that is
    without what the lens leaves open; surface_mm: by how much the mesh is off over whole patches, as the edges show it;
    surface_alike_mm: over which length it is so alike, 0 where the edges do not tell
    ambiguity: directions that the silhouettes leave open, in words; empty if there is none
    xor_pixels: per view, the thesis's measure of mismatch (figure 5.1)
    axis, axis_error: (4,) of the turntable in the object frame at the first angle: rotation vector about x and y by
        which it departs from z (rad), x and y where it passes (mm), and their standard deviations; empty for one angle
    """

    views: tuple[PinholeCamera, ...]
    turns: tuple[F64, ...]
    rotation: F64
    translation: F64
    residual_px: float
    edges: int
    image_covariance: F64
    surface_mm: float = 0.0
    surface_alike_mm: float = 0.0
    ambiguity: tuple[str, ...] = ()
    xor_pixels: tuple[int, ...] = ()
    axis: F64 = field(default_factory=lambda: np.zeros(0))
    axis_error: F64 = field(default_factory=lambda: np.zeros(0))

    def covariance(self, view: int) -> F64:
        """(6, 6) against what the same lens sees elsewhere: of what it leaves open, which it shares, depth alone."""
        out = self.image_covariance[view].copy()
        out[5, 5] = self.translation[view, 2] ** 2
        return np.asarray(out)


@dataclass
class _Sweep:
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

    def moved(self, step: F64) -> _Sweep:
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
            return _Sweep(lenses, self.angles, self.axis, self.errors)
        return _Sweep(lenses, self.angles, self.axis + rest[:4], self.errors + rest[4:])

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


def _lens_rows(sweep: _Sweep) -> Bool:
    """(P,) which increments are of lenses. The boards know these better than any silhouette: they stay as they are."""
    rows = np.zeros(sweep.size, bool)
    for c in range(len(sweep.lenses)):
        rows[(6 + LENS) * c + 6 : (6 + LENS) * (c + 1)] = True
    return rows


def _prior(sweep: _Sweep, share: float = 1.0) -> Prior:
    """Of the increments about the starting values, what is known times `share`; lenses are held."""
    camera = [PLACE_RAD] * 3 + [PLACE_MM] * 3 + [HELD] * LENS
    rest = sweep.size - (6 + LENS) * len(sweep.lenses)
    table = [AXIS_RAD] * 2 + [AXIS_MM] * 2 + [ANGLE_RAD] * (rest - 4)
    sigma = np.array(camera * len(sweep.lenses) + (table if rest else []))
    return Prior.independent(np.zeros(sweep.size), sigma / share)


def fit_poses(
    images: Sequence[NDArray[np.floating]],
    mesh: trimesh.Trimesh,
    cameras: Sequence[PinholeCamera],
    angles: Sequence[float],
    lens_covariance: Sequence[F64] | None = None,
) -> PoseFit:
    """images: per view (cameras outermost), (H, W) radiance under the floodlight; cameras: object frame, first angle.

    lens_covariance: per camera, (4, 4) of focal, centre, k1; None: the lenses are exact

    Raises: DiscoError where no edge lies near the scan's outline.
    """
    exact = [np.zeros((LENS, LENS))] * len(cameras)
    covariance = exact if lens_covariance is None else lens_covariance
    relative = np.asarray(angles, float) - angles[0]
    start = _Sweep(list(cameras), relative, errors=np.zeros(len(relative) - 1))
    masks = [object_mask(image) for image in images]
    return _fine(_coarse(start, masks, mesh), images, masks, mesh, covariance)


def _coarse(start: _Sweep, masks: Sequence[Bool], mesh: trimesh.Trimesh) -> _Sweep:
    """Down the distance to the silhouettes, from several starts that differ by a few degrees; the best by XOR."""
    distances = [signed_distance(m) for m in masks]
    prior = _prior(start, 0.1)
    best, fewest = start, np.inf
    for tilt in _STARTS:
        sweep = start
        for c, camera in enumerate(start.lenses):
            step = np.zeros(start.size)
            step[(6 + LENS) * c : (6 + LENS) * c + 3] = tilt
            sweep = _centred(sweep.moved(step), c, masks[c * len(start.angles)], mesh, camera)
        total: F64 = np.zeros(start.size)
        for _ in range(COARSE_STEPS):
            rims = [outline(mesh, sweep.view(v)) for v in range(len(masks))]
            j = np.concatenate([sweep.jacobian(v, rim) for v, rim in enumerate(rims)])
            away = np.concatenate(
                [
                    ndimage.map_coordinates(distance, rim.pixel.T[::-1] - 0.5, order=1, mode="nearest")
                    for distance, rim in zip(distances, rims, strict=True)
                ]
            )
            weight = np.concatenate([rim.length for rim in rims]) * Huber(HUBER_COARSE_PX).weight(away)
            step = Linearised(total, away, j, weight, prior).step()
            sweep, total = sweep.moved(step), total + step
            if np.abs(step[:3]).max() < 2e-4:
                break
        wrong = sum(int((mesh_mask(mesh, sweep.view(v)) ^ m).sum()) for v, m in enumerate(masks))
        if wrong < fewest:
            best, fewest = sweep, wrong
        if fewest < GOOD_ENOUGH * sum(int(m.sum()) for m in masks):
            break
    return best


_TEN = np.deg2rad(8.0)
_STARTS = np.array([(0, 0, 0), (_TEN, 0, 0), (-_TEN, 0, 0), (0, _TEN, 0), (0, -_TEN, 0), (0, 0, _TEN), (0, 0, -_TEN)])
GOOD_ENOUGH = 0.012  # XOR as a share of the silhouettes: no other start is tried


def _centred(sweep: _Sweep, camera: int, mask: Bool, mesh: trimesh.Trimesh, nominal: PinholeCamera) -> _Sweep:
    """Shift the object before a camera until centroid and area of its silhouette are the photograph's."""
    for _ in range(3):
        seen = sweep.lenses[camera]
        own = mesh_mask(mesh, seen)
        if not own.any() or not mask.any():
            return sweep
        ratio = float(np.sqrt(own.sum() / mask.sum()))
        centre = np.array([ndimage.center_of_mass(m)[::-1] for m in (own, mask)])
        depth = seen.pose[2, 3]
        step = np.zeros(sweep.size)
        at = (6 + LENS) * camera + 3
        step[at : at + 2] = (centre[1] - centre[0]) * depth / seen.focal
        step[at + 2] = depth * (ratio - 1.0)
        sweep = sweep.moved(step)
    return sweep


def _fine(
    sweep: _Sweep,
    images: Sequence[NDArray[np.floating]],
    masks: Sequence[Bool],
    mesh: trimesh.Trimesh,
    lens: Sequence[F64],
) -> PoseFit:
    """Gauss-Newton on the edges, then the covariance from what the edges leave unexplained, sector by sector."""
    prior = _prior(sweep)
    total: F64 = np.zeros(sweep.size)
    for last in range(FINE_STEPS):
        rows = [_edges_of(sweep, v, image, mesh, last >= FINE_STEPS - EXACT_STEPS) for v, image in enumerate(images)]
        j, rest, length, sector, place = (np.concatenate([r[k] for r in rows]) for k in range(5))
        if not len(rest):
            raise DiscoError(
                "the silhouettes show no edge near the scan's outline. Remedy: check that the scan is of this object, "
                "in mm and in the object's frame"
            )
        weight = length * Huber(HUBER_FINE_PX).weight(rest)
        variance = float((weight * rest**2).sum() / weight.sum())
        fit = Linearised(total, -rest, j, weight / variance, prior)
        step = fit.step()
        sweep, total = sweep.moved(step), total + step
    fit = replace(fit, residual=np.asarray(j @ step - rest, np.float64))
    inverse, meat = fit.covariance, fit.scatter(sector)
    for c in range(len(sweep.lenses)):
        common = sector // (SECTORS * len(sweep.angles)) == c
        push = j[common].T @ weight[common] * (COMMON_EDGE_PX / variance)
        meat += np.outer(push, push)
    surface = surface_error(fit, length, place)
    meat += surface.push
    # Lenses are held where the boards put them, but their errors are passed on (Schmidt's consider covariance).
    held = _lens_rows(sweep)
    follow = -inverse[:, ~held] @ fit.information[np.ix_(~held, held)]
    follow[held] = np.eye(int(held.sum()))
    meat[held], meat[:, held] = 0.0, 0.0
    image = inverse @ (meat + np.where(held, 0.0, prior.precision)) @ inverse
    covariance = image + follow @ block_diag(*lens) @ follow.T
    found = _result(sweep, covariance, image, float(np.sqrt(variance)), len(rest), masks, mesh)
    return replace(found, surface_mm=surface.size_mm, surface_alike_mm=surface.alike_mm)


def _edges_of(
    sweep: _Sweep, view: int, image: NDArray[np.floating], mesh: trimesh.Trimesh, exact: bool
) -> tuple[F64, F64, F64, I64, F64]:
    """One view's rows: (K, P) derivative of the edge's place, (K,) pixels it is off, (K,) weight, (K,) sector, (K, 4)
    the place itself, object frame, and pixels per mm of the surface's motion along its normal.

    exact: where the edge is found in a synthetic image of the same pose is taken off, and with it the edge model's bias
    """
    camera = sweep.view(view)
    rim = outline(mesh, camera)
    away, good = edges_along(image, rim.pixel, rim.normal)
    if exact:
        bias, also = edges_along(synthetic(mesh, camera, image), rim.pixel, rim.normal)
        away, good = away - bias, good & also
    j = sweep.jacobian(view, rim)
    around = np.arctan2(*(rim.pixel - rim.pixel.mean(axis=0)).T[::-1]) if len(rim.pixel) else np.zeros(0)
    sector: I64 = view * SECTORS + np.minimum((around / (2 * np.pi) + 0.5) * SECTORS, SECTORS - 1).astype(np.int64)
    depth = rim.points @ camera.pose[2, :3] + camera.pose[2, 3]
    scale = camera.focal.mean() / (depth * np.linalg.norm(rim.across[:, :2], axis=1))
    place = np.column_stack([rim.points, scale])
    return j[good], away[good], rim.length[good], sector[good], place[good]


def _result(
    sweep: _Sweep,
    covariance: F64,
    image: F64,
    residual: float,
    edges: int,
    masks: Sequence[Bool],
    mesh: trimesh.Trimesh,
) -> PoseFit:
    views = [sweep.view(v) for v in range(len(masks))]
    rotation, translation = np.zeros((len(views), 3)), np.zeros((len(views), 3))
    own_image = np.zeros((len(views), 6, 6))
    ambiguity: list[str] = []
    for v, view in enumerate(views):
        j = _pose_jacobian(sweep, v)
        own, own_image[v] = j @ covariance @ j.T, j @ image @ j.T
        rotation[v], translation[v] = np.sqrt(np.diag(own)[:3]), np.sqrt(np.diag(own)[3:])
        for values, vectors, limit, what in (
            (*np.linalg.eigh(own[:3, :3]), UNDETERMINED_RAD, "rotation about"),
            (*np.linalg.eigh(own[3:, 3:]), UNDETERMINED_MM, "shift along"),
        ):
            for value, vector in zip(values, vectors.T, strict=True):
                if value > limit**2:
                    axis = view.pose[:3, :3].T @ vector
                    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
                    ambiguity.append(f"view {v}: {what} ({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f}) of the object")
    xor = tuple(int((mesh_mask(mesh, view) ^ m).sum()) for view, m in zip(views, masks, strict=True))
    first = (6 + LENS) * len(sweep.lenses)
    spread = np.sqrt(np.diag(covariance)[first : first + 4])
    return PoseFit(
        tuple(views),
        tuple(sweep.turns()),
        rotation,
        translation,
        residual,
        edges,
        own_image,
        ambiguity=tuple(ambiguity),
        xor_pixels=xor,
        axis=sweep.axis[: len(spread)],
        axis_error=spread,
    )


def _pose_jacobian(sweep: _Sweep, view: int) -> F64:
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
