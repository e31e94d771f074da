"""Where the laser goes: spots spread evenly over every part of the surface that it can reach.

A grid of mirror steps per turntable angle gives candidates: the beam's axis must hit the object, at an incidence
that is not too oblique (thesis 4.2). Farthest-point sampling over the hits of all angles then keeps the spots
that are wanted, so that density follows the surface and not the mirrors, whatever the number of angles that reach
a place. The order within an angle is coarse to fine: a capture that is broken off still covers the surface evenly.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from hw.base.arrays import F64, I64, Bool
from hw.base.errors import InputError
from hw.interface import Aim
from pipeline.geometry.camera import turn
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.nominal_rig import RigConfig
from pipeline.geometry.projector import TwoMirrorProjector

if TYPE_CHECKING:
    import trimesh


PROBE = 96  # rays per axis of the probing grid: finds parts of the object down to 1 % of its extent
OVERSAMPLING = 8  # candidates per spot; 4 gives visibly uneven distances, 16 hardly changes them


@dataclass(frozen=True)
class Candidates:
    """N aims that hit the object. angle: (N,), steps: (N, 2) int; position: (N, 3) mm in the object frame;
    cosine: (N,) of the incidence."""

    angle: I64
    steps: I64
    position: F64
    cosine: F64

    def __len__(self) -> int:
        return len(self.angle)

    def __getitem__(self, which: Bool | I64) -> Candidates:
        return Candidates(self.angle[which], self.steps[which], self.position[which], self.cosine[which])


def choose_spots(rig: RigConfig, mesh: trimesh.Trimesh) -> tuple[Aim, ...]:
    """Exactly `rig.spots` aims, by turntable angle. Raises: InputError where the laser reaches too few places."""
    projectors = [
        TwoMirrorProjector.from_config(rig.projector).seen_from(turn(angle))
        for angle in np.deg2rad(rig.turntable_angles_deg)
    ]
    steepest = np.cos(np.deg2rad(rig.max_incidence_deg))
    probe = _candidates(projectors, mesh, PROBE)
    if not len(probe):
        raise InputError(
            "the laser never hits the object",
            key="rig.projector.aim_mm",
            value=rig.projector.aim_mm,
            remedy="aim the projector at the object, or widen rig.projector.full_angle_deg",
        )
    share = np.count_nonzero(probe.cosine >= steepest) / PROBE**2
    density = int(np.ceil(np.sqrt(OVERSAMPLING * rig.spots / max(share, 1 / PROBE**2))))
    found = _candidates(projectors, mesh, max(PROBE, density))
    found = found[found.cosine >= steepest]
    if len(found) < rig.spots:
        raise InputError(
            f"the laser reaches the object in {len(found)} places only at this incidence",
            key="rig.spots",
            value=rig.spots,
            allowed=f"at most {len(found)}",
            remedy="fewer spots, more turntable angles, or a larger rig.max_incidence_deg",
        )
    chosen = found[farthest_points(found.position, found.cosine, rig.spots)]
    chosen = chosen[np.argsort(chosen.angle, kind="stable")]
    return tuple(Aim(int(a), int(u), int(v)) for a, (u, v) in zip(chosen.angle, chosen.steps, strict=True))


def _candidates(projectors: list[TwoMirrorProjector], mesh: trimesh.Trimesh, density: int) -> Candidates:
    """All aims of a density x density grid over the object's extent, per angle, that hit the object."""
    surface, parts = RayMesh.of(mesh), []
    for angle, projector in enumerate(projectors):
        extent = projector.steps_to(np.asarray(mesh.vertices, float))
        low = np.clip(np.ceil(extent.min(axis=0)), 0, projector.steps - 1)
        high = np.clip(np.floor(extent.max(axis=0)), 0, projector.steps - 1)
        u, v = (np.unique(np.rint(np.linspace(low[k], high[k], density)).astype(np.int64)) for k in (0, 1))
        for rows in np.array_split(v, max(1, u.size * v.size // 1_000_000)):  # bounds the memory of a dense sweep
            steps = np.stack(np.meshgrid(u, rows), axis=-1).reshape(-1, 2)
            origin, direction = projector.rays(steps.astype(float))
            hit = surface.first_hit(origin, direction)
            ray = np.flatnonzero(hit.triangle >= 0)
            cosine = -np.einsum("ij,ij->i", surface.normals[hit.triangle[ray]], direction[ray])
            position = origin[ray] + hit.distance[ray, None] * direction[ray]
            parts.append(Candidates(np.full(len(ray), angle), steps[ray], position, cosine))
    return Candidates(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Candidates)))


def farthest_points(points: F64, cosine: F64, count: int) -> I64:
    """Indices of `count` of the (N, 3) points, each the one farthest from those before it, coarse to fine.

    Squared distances count in proportion to the cosine, (N,): of two aims at one place the more frontal one wins.
    The first is the most frontal of all. A new point at distance r from the others can only change the distances of
    points within r of it, so the cost is O(N log N) look-ups, not N * count.
    """
    tree = cKDTree(points)
    chosen = np.empty(count, np.int64)
    squared = np.full(len(points), np.inf)
    candidate, reach = int(np.argmax(cosine)), np.inf
    for i in range(count):
        chosen[i] = candidate
        near = slice(None) if not np.isfinite(reach) else np.array(tree.query_ball_point(points[candidate], reach))
        delta = points[near] - points[candidate]
        squared[near] = np.minimum(squared[near], np.einsum("ij,ij->i", delta, delta))
        squared[candidate] = -1.0  # never twice, even where points coincide
        candidate = int(np.argmax(squared * cosine))
        # No point is farther from the chosen ones than this: score >= cosine * distance^2 for every point.
        reach = float(np.sqrt(max(squared.max(), 0.0))) * (1 + 1e-9)
    return chosen
