"""The object's mesh: what light cannot be traced in is refused; distances; hat functions of the scan on it."""

from __future__ import annotations

from pathlib import Path

import gpytoolbox
import numpy as np
import scipy.sparse
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from hw.base.arrays import F64
from hw.base.errors import InputError
from pipeline.geometry.mesh import arrays
from pipeline.geometry.mesh_file import load_mesh, mending, require_closed, require_size

KEY = "object.shape.file"

MARGIN = 1e-4  # of an edge, or of a triangle's height: nearer to its border it is a touch, not a crossing
FINE_TRIANGLES = 20_000  # truth is tallied on the mesh's vertices: triangles are cut in four until there are so many


def read_mesh(path: Path, key: str = KEY) -> trimesh.Trimesh:
    """A closed, outward oriented mesh in mm from a PLY, OBJ or STL file. key: of the file in the scene.

    Raises: InputError for anything else.
    """
    mesh = load_mesh(path, key)
    check_mesh(mesh, path, key)
    while len(mesh.faces) < FINE_TRIANGLES:
        mesh = trimesh.Trimesh(*trimesh.remesh.subdivide(mesh.vertices, mesh.faces), process=False)
    return mesh


def check_mesh(mesh: trimesh.Trimesh, path: Path, key: str = KEY) -> None:
    """Refuse a mesh that light cannot be traced in, or that was not meant in mm. Raises: InputError."""
    require_size(mesh, path, key)
    require_closed(mesh, path, key)
    _check_shells(mesh, path, key)


def _check_shells(mesh: trimesh.Trimesh, path: Path, key: str) -> None:
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
            raise InputError("the mesh is inside out", file=path, key=key, remedy=mending(path))
        if cavity:
            problem, remedy = f"{where} lies inside another one and is not oriented inwards", "orient it as a cavity"
            raise InputError(problem, file=path, key=key, remedy=f"{remedy}, or take it out")
        raise InputError(f"{where} is inside out", file=path, key=key, remedy=mending(path))


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


def distance_to(mesh: trimesh.Trimesh, points: F64) -> F64:
    """(N,) unsigned distance to the surface of (N, 3) points."""
    v, f = arrays(mesh)
    squared: F64 = np.asarray(gpytoolbox.squared_distance(points, v, f, use_cpp=True)[0], float)
    return np.asarray(np.sqrt(squared))


def depth(mesh: trimesh.Trimesh, points: F64) -> F64:
    """(N,) distance to the surface of (N, 3) points, positive inside."""
    v, f = arrays(mesh)
    return -np.asarray(gpytoolbox.signed_distance(points, v, f)[0], float)


def hat_basis(fine: trimesh.Trimesh, scan: trimesh.Trimesh) -> scipy.sparse.csr_matrix:
    """(V_fine, V_scan) values of the scan's hat functions at the fine vertices' closest points on the scan.

    Rows are barycentric weights: not negative, sum 1. The identity where both meshes are the same.
    Raises: InputError where a hat function holds no fine vertex.
    """
    if fine.vertices.shape == scan.vertices.shape and np.array_equal(fine.vertices, scan.vertices):
        return scipy.sparse.identity(len(fine.vertices), format="csr")
    _, triangle, weights = gpytoolbox.squared_distance(arrays(fine)[0], *arrays(scan), use_cpp=True)
    weights = np.clip(weights, 0, None)
    weights /= weights.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(weights)), 3)
    columns = np.asarray(scan.faces)[triangle].ravel()
    shape = (len(fine.vertices), len(scan.vertices))
    basis = scipy.sparse.coo_matrix((weights.ravel(), (rows, columns)), shape=shape).tocsr()
    empty = int((basis.sum(axis=0) <= 0).sum())
    if empty:
        problem = f"{empty} vertices of the scan are not resolved by the object's mesh"
        raise InputError(problem, key="scan.vertices", remedy="lower scan.vertices, or give a finer mesh")
    return basis
