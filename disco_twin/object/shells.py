"""Shells of a closed mesh: which way each is oriented, and whether the surface runs through itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.ray.ray_pyembree import RayMeshIntersector

from hw.base.errors import InputError

F64 = NDArray[np.float64]
MARGIN = 1e-4  # of an edge, or of a triangle's height: nearer to its border it is a touch, not a crossing


def check_shells(mesh: trimesh.Trimesh, path: Path, key: str, flip: str) -> None:
    """Refuse a closed, consistently oriented mesh whose shells do not bound a solid.

    A shell inside another one is a cavity and has to be oriented inwards; one inside a cavity is solid again.
    Raises: InputError.
    """
    place = crossing(mesh)
    if place is not None:
        problem = f"the mesh intersects itself near {np.round(place, 2).tolist()} mm"
        raise InputError(problem, file=path, key=key, remedy="unite its parts (a boolean union, or a voxel remesh)")
    parts = mesh.split(only_watertight=False)
    for part in parts:
        around = [o for o in parts if o is not part and o.contains(part.vertices[:1])[0]]
        cavity = len(around) % 2 == 1
        if (part.volume < 0) == cavity and part.volume != 0:
            continue
        where = f"the shell of {len(part.faces)} triangles around {np.round(part.bounds.mean(axis=0), 1).tolist()} mm"
        if len(parts) == 1:
            raise InputError("the mesh is inside out", file=path, key=key, remedy=flip)
        if cavity:
            problem, remedy = f"{where} lies inside another one and is not oriented inwards", "orient it as a cavity"
            raise InputError(problem, file=path, key=key, remedy=f"{remedy}, or take it out")
        raise InputError(f"{where} is inside out", file=path, key=key, remedy=flip)


def crossing(mesh: trimesh.Trimesh) -> F64 | None:
    """(3,) a point where an edge passes through a triangle that it has no vertex in common with; None: nowhere.

    Two triangles that cross have an edge of one through the inside of the other. Embree proposes the pairs, double
    precision decides.
    """
    edges = np.asarray(mesh.edges_unique)
    start, end = (np.asarray(mesh.vertices, np.float64)[edges[:, k]] for k in (0, 1))
    length = np.linalg.norm(end - start, axis=1)
    direction = (end - start) / length[:, None]
    face, ray = RayMeshIntersector(mesh).intersects_id(start, direction, multiple_hits=True, max_hits=32)
    apart = ~(np.asarray(mesh.faces)[face][:, :, None] == edges[ray][:, None, :]).any(axis=(1, 2))
    face, ray = face[apart], ray[apart]
    corner = np.asarray(mesh.triangles, np.float64)[face]
    normal = np.asarray(mesh.face_normals)[face]
    across = (direction[ray] * normal).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((corner[:, 0] - start[ray]) * normal).sum(axis=1) / across
    share = distance / length[ray]
    inside = (np.abs(across) > 1e-9) & (share > MARGIN) & (share < 1 - MARGIN)
    point = start[ray[inside]] + distance[inside, None] * direction[ray[inside]]
    weights = trimesh.triangles.points_to_barycentric(corner[inside], point)
    found = np.flatnonzero((weights > MARGIN).all(axis=1))
    return np.asarray(point[found[0]]) if len(found) else None
