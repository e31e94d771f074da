"""Where the object stands before each camera, from silhouettes (thesis 5.2.2), all views of a sweep together.

Unknown are each camera's pose at the first turntable angle, the turntable's axis and the angles' small errors; what the
boards left open of each camera's lens is carried into the poses' uncertainty. A coarse stage walks down the distance to
the photographed silhouette from centimetres and ten degrees away, a fine one fits edges to a few hundredths of a pixel.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.linalg import block_diag

from hw.base.arrays import F64, I64, Bool
from hw.base.outcome import Ended, Outcome
from pipeline.calibrate.edges import Edges
from pipeline.calibrate.least_squares import Huber, Linearised
from pipeline.calibrate.outline import outline, signed_distance
from pipeline.calibrate.scan_error import surface_error
from pipeline.calibrate.scan_fit import ScanFit, fit_scan
from pipeline.calibrate.sweep import LENS, Sweep, lens_rows, place_prior, pose_jacobian
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.silhouette import mesh_mask, object_mask

log = logging.getLogger(__name__)

UNDETERMINED_RAD, UNDETERMINED_MM = np.deg2rad(1.0), 5.0  # a direction that is known no better is stated as open
COARSE_STEPS, FINE_STEPS, EXACT_STEPS = 25, 5, 2
SETTLED_PX = 0.1  # by which edges may move, root mean square, in the last step
HUBER_COARSE_PX, HUBER_FINE_PX = 3.0, 0.15
COMMON_EDGE_PX = 0.003  # edges of a camera may be off together by this


@dataclass(frozen=True)
class PoseFit:
    """views: per view, camera in the object frame; turns: per angle, (4, 4) object -> object at the first angle.

    rotation, translation: (V, 3) standard deviations of each view's pose: of the object about its own origin, in rad
    along the camera's axes, and of the origin, mm; residual_px: root mean square of the edges; edges: their number
    image_covariance: (V, 6, 6) the same rotation and translation as far as they move the object in the image, that is
    without what the lens leaves open; surface_mm: by how much the mesh is off over whole patches, as the edges show it;
    surface_alike_mm: over which length it is so alike, 0 where the edges do not tell; scan: fitted to the same edges
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
    scan: ScanFit
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
    start = Sweep(list(cameras), relative, errors=np.zeros(len(relative) - 1))
    masks = [object_mask(image) for image in images]
    return _fine(_coarse(start, masks, mesh), images, masks, mesh, covariance)


def _coarse(start: Sweep, masks: Sequence[Bool], mesh: trimesh.Trimesh) -> Sweep:
    """Down the distance to the silhouettes, from several starts that differ by a few degrees; the best by XOR."""
    distances = [signed_distance(m) for m in masks]
    prior = place_prior(start, 0.1)
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
        area, length = sum(int(m.sum()) for m in masks), sum(float(rim.length.sum()) for rim in rims)
        if fewest < max(GOOD_ENOUGH * area, GOOD_ENOUGH_PX * length):
            break
    return best


_TEN = np.deg2rad(8.0)
_STARTS = np.array([(0, 0, 0), (_TEN, 0, 0), (-_TEN, 0, 0), (0, _TEN, 0), (0, -_TEN, 0), (0, 0, _TEN), (0, 0, -_TEN)])
# XOR as a share of the silhouettes, or by pixels along the outline, where that allows more, as it does in small images:
GOOD_ENOUGH, GOOD_ENOUGH_PX = 0.012, 0.35  # no other start is tried then


def _centred(sweep: Sweep, camera: int, mask: Bool, mesh: trimesh.Trimesh, nominal: PinholeCamera) -> Sweep:
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
    sweep: Sweep,
    images: Sequence[NDArray[np.floating]],
    masks: Sequence[Bool],
    mesh: trimesh.Trimesh,
    lens: Sequence[F64],
) -> PoseFit:
    """Gauss-Newton on the edges, then with the scan's surface where that is off."""
    prior, normals, total = place_prior(sweep), np.asarray(mesh.vertex_normals), np.zeros(sweep.size)
    for last in range(FINE_STEPS):
        edges = Edges.of(sweep, images, mesh, normals, last >= FINE_STEPS - EXACT_STEPS)
        weight = edges.length * Huber(HUBER_FINE_PX).weight(edges.away)
        variance = float((weight * edges.away**2).sum() / weight.sum())
        fit = Linearised(total, -edges.away, edges.jacobian, weight / variance, prior)
        step = fit.step()
        sweep, total = sweep.moved(step), total + step
    if np.sqrt(((edges.jacobian @ step) ** 2).mean()) > SETTLED_PX:
        Ended(Outcome.STOPPED, FINE_STEPS).warn(log, "the fit of poses to edges")
    joint, scanned = fit_scan(sweep, images, mesh), mesh
    if joint.scan.because:
        fit = replace(fit, residual=np.asarray(edges.jacobian @ step - edges.away, np.float64))
        surface = surface_error(fit, edges.length, np.column_stack([edges.place, edges.scale]))
        meat, size, alike = fit.scatter(edges.sector) + surface.push, surface.size_mm, surface.alike_mm
    else:
        sweep, fit, edges, scanned = joint.sweep, joint.fit, joint.edges, joint.scan.moved(mesh)
        meat, size, alike = fit.information, joint.scan.size_mm, joint.scan.alike_mm
    p = sweep.size
    covariance, image = _spread(fit, meat, edges.view // len(sweep.angles), lens_rows(sweep), lens)
    scan = joint.scan
    if not scan.because:
        scan, frame = joint.with_error(covariance), joint.frame(np.asarray(mesh.vertices).mean(axis=0))
        covariance[:p, :p] += frame
        image[:p, :p] += frame
    residual = float(np.sqrt((fit.weight * fit.residual**2).sum() / fit.weight.sum()))
    found = _result(sweep, covariance[:p, :p], image[:p, :p], scan, masks, scanned)
    return replace(found, residual_px=residual, edges=len(edges.away), surface_mm=size, surface_alike_mm=alike)


def _spread(fit: Linearised, scatter: F64, camera: I64, lenses: Bool, lens: Sequence[F64]) -> tuple[F64, F64]:
    """(P, P) covariance of a fit's unknowns, and without what the lenses leave open.

    scatter: (P, P) of the fit's gradient by the edges' own errors; camera: (K,) of each edge, which may be off together
    with its others; lenses: (P0,) which of the first unknowns are of lenses: they are held where the boards put them,
    but their errors, lens: (4, 4) per camera, are passed on (Schmidt's consider covariance)
    """
    inverse, held = fit.covariance, np.zeros(len(fit.value), bool)
    held[: len(lenses)] = lenses
    for c in range(len(lens)):
        push = fit.jacobian[camera == c].T @ (fit.weight[camera == c] * COMMON_EDGE_PX)
        scatter = scatter + np.outer(push, push)
    follow = -inverse[:, ~held] @ fit.information[np.ix_(~held, held)]
    follow[held] = np.eye(int(held.sum()))
    scatter[held], scatter[:, held] = 0.0, 0.0
    image = inverse @ (scatter + np.where(held, 0.0, fit.prior.precision)) @ inverse
    return np.asarray(image + follow @ block_diag(*lens) @ follow.T), np.asarray(image)


def _result(
    sweep: Sweep,
    covariance: F64,
    image: F64,
    scan: ScanFit,
    masks: Sequence[Bool],
    mesh: trimesh.Trimesh,
) -> PoseFit:
    views = [sweep.view(v) for v in range(len(masks))]
    rotation, translation = np.zeros((len(views), 3)), np.zeros((len(views), 3))
    own_image = np.zeros((len(views), 6, 6))
    ambiguity: list[str] = []
    for v, view in enumerate(views):
        j = pose_jacobian(sweep, v)
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
        0.0,
        0,
        own_image,
        scan,
        ambiguity=tuple(ambiguity),
        xor_pixels=xor,
        axis=sweep.axis[: len(spread)],
        axis_error=spread,
    )
