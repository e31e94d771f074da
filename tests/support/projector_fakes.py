"""Spots on an object, and the projector fitted to them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from calibrate_twin import experiment, faulty_rig, shifted
from numpy.typing import NDArray
from trimesh.ray.ray_pyembree import RayMeshIntersector

from disco_twin.faults.actual_rig import actual_rig
from pipeline.calibrate.projector_fit import ProjectorFit, StepSize, refine, true_spots
from pipeline.geometry.projector import TwoMirrorProjector

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Lit:
    """Spots in the world frame of a seeded rig whose turntable is exact."""

    nominal: TwoMirrorProjector
    actual: TwoMirrorProjector
    points: F64
    seen: F64  # with noise, the peak's shift and false spots
    steps: F64
    normals: F64
    to_eye: F64
    directions: F64
    false: NDArray[np.bool_]
    size: StepSize


def lit(seed: int, noise: float = 0.05, false: float = 0.2) -> Lit:
    rig, rng, mesh = faulty_rig(), np.random.default_rng(seed), experiment().object.mesh
    actual = actual_rig(rig, seed)
    turns = [actual.turns[aim.angle] for aim in experiment().plan.spots]
    origin, way = actual.spot_rays(experiment().plan.spots)
    points, ray, face = RayMeshIntersector(mesh).intersects_location(origin, way, multiple_hits=False)
    normals, way = mesh.face_normals[face], way[ray]
    moved = [turns[r] for r in ray]
    world_points = np.array([t[:3, :3] @ p + t[:3, 3] for t, p in zip(moved, points, strict=True)])
    normals, way = (np.array([t[:3, :3] @ x for t, x in zip(moved, v, strict=True)]) for v in (normals, way))
    eye = actual.cameras[0].position - world_points
    eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    error = noise * rng.standard_normal(points.shape)
    error -= (error * normals).sum(axis=1, keepdims=True) * normals
    seen = world_points + error
    for direction in (way, eye):
        seen = seen + shifted(direction - (direction * normals).sum(axis=1, keepdims=True) * normals)
    bad = rng.random(len(points)) < false
    seen[bad] += 8 * rng.standard_normal((bad.sum(), 3))
    steps = np.array([(experiment().plan.spots[r].u, experiment().plan.spots[r].v) for r in ray], float)
    full = actual.projector.full_angle_rad
    size = StepSize(full * (1 + 0.002 * rng.standard_normal(2)), np.diag((0.002 * full) ** 2))
    nominal = TwoMirrorProjector.from_config(rig.projector)
    return Lit(nominal, actual.projector, world_points, seen, steps, normals, eye, way, bad, size)


def fitted(spots: Lit, **changes: object) -> ProjectorFit:
    spots = replace(spots, **changes)  # type: ignore[arg-type]
    kept = true_spots(spots.seen, spots.steps, 40.0, np.random.default_rng(0))
    arguments = (spots.seen[kept], spots.steps[kept], spots.normals[kept], spots.to_eye[kept], spots.size)
    return refine(spots.nominal, *arguments)


def accuracy(fit: ProjectorFit, spots: Lit) -> tuple[float, float]:
    """Root mean square distance of predicted spots on the surface in mm; largest error of incidence in degrees."""
    origin, way = fit.projector.rays(spots.steps)
    along = ((spots.points - origin) * spots.normals).sum(axis=1) / (way * spots.normals).sum(axis=1)
    miss = np.linalg.norm(origin + along[:, None] * way - spots.points, axis=1)
    turned = np.arccos(np.clip((way * spots.directions).sum(axis=1), -1, 1))
    return float(np.sqrt((miss**2).mean())), float(np.rad2deg(turned).max())
