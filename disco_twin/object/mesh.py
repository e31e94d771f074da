"""Meshes: what is refused, the coarser scan that the pipeline is given, hat functions from one mesh to the other."""

from __future__ import annotations

from pathlib import Path

import gpytoolbox
import numpy as np
import scipy.sparse
import trimesh
from numpy.typing import NDArray
from trimesh.ray.ray_pyembree import RayMeshIntersector

from hw.base.arrays import F64, I64
from hw.base.errors import InputError

KEY = "object.shape.file"

LARGEST_MM, SMALLEST_MM = 2000.0, 1.0  # extents that a rig of about 500 mm working distance can mean
THINNEST = 1e-3  # of its largest extent: light is traced in single precision
MARGIN = 1e-4  # of an edge, or of a triangle's height: nearer to its border it is a touch, not a crossing
FINE_TRIANGLES = 20_000  # truth is tallied on the mesh's vertices: triangles are cut in four until there are so many


def read_mesh(path: Path) -> trimesh.Trimesh:
    """A closed, outward oriented mesh in mm from a PLY, OBJ or STL file. Raises: InputError for anything else."""
    if path.suffix.lower() not in (".ply", ".obj", ".stl"):
        raise InputError("unknown type of mesh file", file=path, key=KEY, allowed=".ply, .obj, .stl", remedy=_EXPORT)
    try:
        loaded = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # the loaders raise whatever their parsing trips over
        why = f": {error.strerror}" if isinstance(error, OSError) and error.strerror else ""
        problem = f"cannot be read as a {path.suffix[1:].upper()} mesh{why}"
        raise InputError(problem, file=path, key=KEY, remedy=_EXPORT) from error
    faces = np.asarray(getattr(loaded, "faces", ()), dtype=np.int64).reshape(-1, 3)
    if len(faces) == 0:
        raise InputError("the mesh is empty (no triangles)", file=path, key=KEY, remedy=_EXPORT)
    if faces.min() < 0 or faces.max() >= len(loaded.vertices):
        raise InputError("a triangle names a vertex that does not exist", file=path, key=KEY, remedy=_EXPORT)
    if not np.isfinite(np.asarray(loaded.vertices)[faces]).all():
        raise InputError("a vertex is not a finite number", file=path, key=KEY, remedy=_EXPORT)
    # Vertices that files repeat per triangle (STL) or per texture seam (OBJ) are one vertex; slivers without area go.
    mesh = trimesh.Trimesh(np.array(loaded.vertices), faces, process=False)
    mesh.merge_vertices()
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    check_mesh(mesh, path)
    while len(mesh.faces) < FINE_TRIANGLES:
        mesh = trimesh.Trimesh(*trimesh.remesh.subdivide(mesh.vertices, mesh.faces), process=False)
    return mesh


def check_mesh(mesh: trimesh.Trimesh, path: Path) -> None:
    """Refuse a mesh that light cannot be traced in, or that was not meant in mm. Raises: InputError."""
    if len(mesh.faces) == 0:
        problem = "the mesh is empty (all its triangles are degenerate)"
        raise InputError(problem, file=path, key=KEY, remedy=_EXPORT)
    check_size(mesh, KEY, path)
    if not mesh.is_watertight:
        _, count = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
        problem = f"the mesh is not closed ({(count != 2).sum()} of {len(count)} edges do not join two triangles)"
        raise InputError(problem, file=path, key=KEY, remedy="fill its holes")
    if not mesh.is_winding_consistent:
        raise InputError("the mesh's triangles are not all oriented the same way", file=path, key=KEY, remedy=_FLIP)
    _check_shells(mesh, path)


def _check_shells(mesh: trimesh.Trimesh, path: Path) -> None:
    """Refuse a closed, consistently oriented mesh whose shells do not bound a solid.

    A shell inside another one is a cavity and has to be oriented inwards; one inside a cavity is solid again.
    Raises: InputError.
    """
    place = _crossing(mesh)
    if place is not None:
        problem = f"the mesh intersects itself near {np.round(place, 2).tolist()} mm"
        raise InputError(problem, file=path, key=KEY, remedy="unite its parts (a boolean union, or a voxel remesh)")
    parts = mesh.split(only_watertight=False)
    for part in parts:
        around = [o for o in parts if o is not part and o.contains(part.vertices[:1])[0]]
        cavity = len(around) % 2 == 1
        if (part.volume < 0) == cavity and part.volume != 0:
            continue
        where = f"the shell of {len(part.faces)} triangles around {np.round(part.bounds.mean(axis=0), 1).tolist()} mm"
        if len(parts) == 1:
            raise InputError("the mesh is inside out", file=path, key=KEY, remedy=_FLIP)
        if cavity:
            problem, remedy = f"{where} lies inside another one and is not oriented inwards", "orient it as a cavity"
            raise InputError(problem, file=path, key=KEY, remedy=f"{remedy}, or take it out")
        raise InputError(f"{where} is inside out", file=path, key=KEY, remedy=_FLIP)


def _crossing(mesh: trimesh.Trimesh) -> F64 | None:
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


def check_size(mesh: trimesh.Trimesh, key: str, path: Path | None = None) -> None:
    """Refuse what no rig of about 500 mm working distance can scan, and plates too thin for single precision.

    Raises: InputError.
    """
    size, thinnest = float(mesh.extents.max()), float(mesh.extents.min())
    remedy = None
    if size < SMALLEST_MM:
        remedy = "scale it by 1000 if it is in metres"
    elif not size <= LARGEST_MM:
        remedy = "scale it by 0.001 if it is in micrometres"
    if remedy:
        raise InputError(f"the object is {size:.3g} mm large", file=path, key=key, allowed=_SIZES, remedy=remedy)
    if not thinnest >= size * THINNEST:
        problem = f"the object is {size:.3g} mm large and {thinnest:.3g} mm thin"
        raise InputError(problem, file=path, key=key, allowed=f"thickness >= {THINNEST:g} of it", remedy="thicken it")


_SIZES = f"{SMALLEST_MM:g} .. {LARGEST_MM:g} mm"
_EXPORT = "export the mesh again as a binary PLY, closed and in mm"
_FLIP = "recompute its normals outside"


def closest(mesh: trimesh.Trimesh, points: F64) -> tuple[F64, I64]:
    """(N, 3) closest points on the surface to (N, 3) points, and (N,) the triangles that they lie on."""
    v, f = _arrays(mesh)
    _, triangle, weights = gpytoolbox.squared_distance(points, v, f, use_cpp=True)
    return np.einsum("nk,nkd->nd", weights, v[f[triangle]]), triangle.astype(np.int64)


def distance_to(mesh: trimesh.Trimesh, points: F64) -> F64:
    """(N,) unsigned distance to the surface of (N, 3) points."""
    v, f = _arrays(mesh)
    squared: F64 = np.asarray(gpytoolbox.squared_distance(points, v, f, use_cpp=True)[0], float)
    return np.asarray(np.sqrt(squared))


def depth(mesh: trimesh.Trimesh, points: F64) -> F64:
    """(N,) distance to the surface of (N, 3) points, positive inside."""
    v, f = _arrays(mesh)
    return -np.asarray(gpytoolbox.signed_distance(points, v, f)[0], float)


def remesh(mesh: trimesh.Trimesh, vertices: int) -> trimesh.Trimesh:
    """About `vertices` vertices near the surface of `mesh`, triangles of nearly equal area (Botsch and Kobbelt 2004).

    The result is scaled about its centroid to the area of `mesh`: flat triangles between points of a convex surface
    lie inside it and would receive too little light. Raises: InputError where no closed mesh comes out.
    """
    edge = float(np.sqrt(mesh.area / (2 * vertices) * 4 / np.sqrt(3)))
    out = mesh
    for _ in range(6):
        v, f = gpytoolbox.remesh_botsch(*_arrays(mesh), 20, edge, True)
        out = trimesh.Trimesh(v, f, process=False)
        if abs(len(v) / vertices - 1) < 0.01:
            break
        edge *= float(np.sqrt(len(v) / vertices))
    if not (out.is_watertight and out.is_winding_consistent and out.volume > 0):
        remedy = "raise scan.vertices, or leave it out to hand over the object's own mesh"
        raise InputError("no closed mesh of so few vertices", key="scan.vertices", value=vertices, remedy=remedy)
    centre = out.centroid
    scale = np.sqrt(mesh.area / out.area)
    return trimesh.Trimesh(centre + (out.vertices - centre) * scale, out.faces, process=False)


def hat_basis(fine: trimesh.Trimesh, scan: trimesh.Trimesh) -> scipy.sparse.csr_matrix:
    """(V_fine, V_scan) values of the scan's hat functions at the fine vertices' closest points on the scan.

    Rows are barycentric weights: not negative, sum 1. The identity where both meshes are the same.
    """
    if fine.vertices.shape == scan.vertices.shape and np.array_equal(fine.vertices, scan.vertices):
        return scipy.sparse.identity(len(fine.vertices), format="csr")
    _, triangle, weights = gpytoolbox.squared_distance(_arrays(fine)[0], *_arrays(scan), use_cpp=True)
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


def _arrays(mesh: trimesh.Trimesh) -> tuple[F64, NDArray[np.int32]]:
    """Plain (V, 3) float64 and (F, 3) int32 arrays, as gpytoolbox's C++ asks for."""
    return np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int32)
