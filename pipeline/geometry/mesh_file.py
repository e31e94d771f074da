"""A mesh from a file: the object's, and the scan's. One loader, so that both mean the same surface by the same file.

What a file may hold is read in `pipeline.geometry.mesh_formats`. Here polygons become triangles, what no triangle needs
goes, and what cannot be the surface of a solid of the rig's size is refused.
"""

from __future__ import annotations

from pathlib import Path

import gpytoolbox
import numpy as np
import trimesh

from hw.base.arrays import F64, I64
from hw.base.errors import InputError
from pipeline.geometry.mesh_formats import Polygons, read_obj, read_ply, read_stl

LARGEST_MM, SMALLEST_MM = 2000.0, 1.0  # extents that a rig of about 500 mm working distance can mean
THINNEST = 1e-3  # of its largest extent: light is traced in single precision
FARTHEST = 1e30  # coordinates whose fourth power is still a number
FLAT = 1e-8  # height of a triangle, relative to its longest edge, below which it has no area
MOST_CUTS = 32  # rounds: as many triangles without area may lie on one another
AREA_SHARE = 1e-6  # by which a polygon's triangles may miss its area

READERS = {".ply": read_ply, ".obj": read_obj, ".stl": read_stl}
TYPES = ", ".join(READERS)
EXPORT = "export the mesh again as a binary PLY, closed and in mm"
MAGIC = {
    b"ply": ".ply", b"solid": ".stl", b"glTF": ".glb", b"OFF": ".off", b"PK\3\4": ".zip", b"\x1f\x8b": ".gz",
    b"\x89PNG": ".png", b"\xff\xd8\xff": ".jpg", b"%PDF": ".pdf", b"<": ".xml or .html", b"Kaydara FBX": ".fbx",
    b"BLENDER": ".blend",
}  # fmt: skip


def load_mesh(path: Path, key: str | None = None) -> trimesh.Trimesh:
    """The triangles of a PLY, OBJ or STL file, vertices in the file's unit and order.

    Vertices that no triangle has and triangles without area are left out. Vertices in the same place become one where
    the mesh is not closed without that: files repeat them at every triangle (STL) or at seams of a texture.
    key: what a refusal names. Raises: InputError, open and inverted meshes pass.
    """
    kind = path.suffix.lower()
    if kind not in READERS:
        raise InputError("unknown type of mesh file", file=path, key=key, allowed=TYPES, remedy=EXPORT)
    try:
        with np.errstate(all="ignore"):  # what is no number is refused by name
            mesh = _mesh(READERS[kind](_bytes(path, kind)))
    except OSError as error:
        why = f" ({error.strerror})" if error.strerror else ""
        raise InputError(f"cannot be read{why}", file=path, key=key, remedy="correct the path") from error
    except InputError as error:
        raise error.amended(file=path, key=key, remedy=error.remedy or EXPORT) from error.__cause__
    return mesh


def read_scan(path: Path, remedy: str | None = None) -> trimesh.Trimesh:
    """The scanned mesh in mm, vertices as they are numbered in the file.

    remedy: instead of exporting or mending the mesh, where the file is a capture's own copy. Raises: InputError where
    it cannot be read, or is not a closed surface oriented outward, of the rig's size.
    """
    try:
        mesh = load_mesh(path)
        require_size(mesh, path)
        require_closed(mesh, path)
        if mesh.volume <= 0:
            raise InputError("the mesh is inside out", file=path, remedy=mending(path))
    except InputError as error:
        raise (error.amended(remedy=remedy) if remedy else error) from error.__cause__
    return mesh


def require_size(mesh: trimesh.Trimesh, path: Path | None, key: str | None = None) -> None:
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
        allowed = f"{SMALLEST_MM:g} .. {LARGEST_MM:g} mm"
        raise InputError(f"the object is {size:.3g} mm large", file=path, key=key, allowed=allowed, remedy=remedy)
    if not thinnest >= size * THINNEST:
        problem = f"the object is {size:.3g} mm large and {thinnest:.3g} mm thin"
        raise InputError(problem, file=path, key=key, allowed=f"thickness >= {THINNEST:g} of it", remedy="thicken it")


def require_closed(mesh: trimesh.Trimesh, path: Path, key: str | None = None) -> None:
    """Refuse a mesh whose triangles do not close, or do not all face the same side. Raises: InputError."""
    if not mesh.is_watertight:
        _, count = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
        problem = f"the mesh is not closed ({(count != 2).sum()} of {len(count)} edges do not join two triangles)"
        raise InputError(problem, file=path, key=key, remedy=mending(path))
    if not mesh.is_winding_consistent:
        problem = "the mesh's triangles are not all oriented the same way"
        raise InputError(problem, file=path, key=key, remedy=mending(path))


def mending(path: Path) -> str:
    """The remedy for what the command `mesh` mends."""
    return f"`disco-twin mesh {path} {path.with_name(f'{path.stem}-closed.ply')}` closes it and orients it outward"


def _bytes(path: Path, kind: str) -> bytes:
    """Raises: OSError; InputError where another type of file has that name."""
    data = path.read_bytes()
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        data = data.decode("utf-16", errors="replace").encode()
    data = data.removeprefix(b"\xef\xbb\xbf")  # byte order marks: of Windows' editors
    if not data:
        raise InputError("the mesh is empty (no bytes)")
    if data.startswith(b"version https://git-lfs"):
        raise InputError("is a pointer of Git LFS, not the mesh", remedy="git lfs pull")
    for magic, other in MAGIC.items():
        if data.startswith(magic) and other != kind:
            remedy = f"name it {other}" if other in READERS else EXPORT
            raise InputError(f"is a {other} file by its content", remedy=remedy)
    if kind == ".ply" and not data.startswith(b"ply"):
        raise InputError("is no PLY file")
    return data


# ---------------------------------------------------------------- from polygons to a mesh
def _mesh(polygons: Polygons) -> trimesh.Trimesh:
    """Raises: InputError."""
    corners, vertices = polygons.corners, polygons.vertices
    if len(corners) and (corners.min() < 0 or corners.max() >= len(vertices)):
        raise InputError("a triangle names a vertex that does not exist")
    if not (np.abs(vertices[corners]) < FARTHEST).all():  # nor NaN
        raise InputError("a vertex is not a finite number")
    faces = triangulate(polygons)
    if not len(faces):
        raise InputError("the mesh is empty (no triangles)")
    mesh = with_area(vertices, faces)
    if not mesh.is_watertight:
        _, first, same = np.unique(vertices + 0.0, axis=0, return_index=True, return_inverse=True)  # -0 is 0
        mesh = with_area(vertices, first[same.ravel()][faces])
    if not len(mesh.faces):
        raise InputError("the mesh is empty (all its triangles are degenerate)")
    return mesh


def with_area(vertices: F64, faces: I64, flat: float = FLAT) -> trimesh.Trimesh:
    """Without triangles that have no area, and without vertices that no triangle has.

    flat: height relative to the longest edge that is none. A triangle whose corners lie on a line cannot just go, its
    longest edge would be left without it: the triangle on the other side of that edge is cut in two at the corner in
    between, if there is one.
    """
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    for _ in range(MOST_CUTS):
        none = _flat(vertices, faces, flat)
        cut = _cut_beside(vertices, faces, none) if len(none) else faces
        if cut is faces:
            break
        faces = cut
    faces = np.delete(faces, _flat(vertices, faces, flat), axis=0)
    used = np.unique(faces)
    number = np.zeros(len(vertices), np.int64)
    number[used] = np.arange(len(used))
    return trimesh.Trimesh(vertices[used], number[faces], process=False)


def _flat(vertices: F64, faces: I64, flat: float) -> I64:
    """Numbers of the triangles without area."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    longest = np.max([((b - a) ** 2).sum(axis=1), ((c - b) ** 2).sum(axis=1), ((a - c) ** 2).sum(axis=1)], axis=0)
    return np.flatnonzero(np.linalg.norm(np.cross(b - a, c - a), axis=1) <= flat * longest)


def _cut_beside(vertices: F64, faces: I64, flat: I64) -> I64:
    """Flip the longest edges of flat triangles, as many as share no triangle; `faces` itself where none can be."""
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    wanted, touched, cut = dict[tuple[int, int], list[int]](), set[int](), faces.copy()
    sides = []
    for t in flat.tolist():
        length = [float(((vertices[faces[t, k]] - vertices[faces[t, k - 2]]) ** 2).sum()) for k in range(3)]
        k = int(np.argmax(length))
        sides.append((t, k))
        wanted[tuple(ends[3 * t + k].tolist())] = []
    for side in np.flatnonzero(np.isin(ends[:, 0], [e[0] for e in wanted])).tolist():
        if (edge := tuple(ends[side].tolist())) in wanted:
            wanted[edge].append(side)
    for t, k in sides:
        beside = [side for side in wanted[tuple(ends[3 * t + k].tolist())] if side // 3 != t]
        if len(beside) != 1 or not touched.isdisjoint({t, beside[0] // 3}):
            continue
        other, m = divmod(beside[0], 3)
        start, end, between = faces[t, k], faces[t, k - 2], faces[t, k - 1]
        top = faces[other, m - 1]
        if top == between or faces[other, m] != end:
            continue
        cut[t], cut[other] = (between, top, end), (between, start, top)
        touched |= {t, other}
    return cut if touched else faces


def triangulate(polygons: Polygons) -> I64:
    """(F, 3) triangles of all polygons in their order, each polygon's with its area and orientation.

    A quadrilateral is cut along the diagonal whose smaller triangle is the larger one. What has more corners is
    triangulated in the plane of its area vector (Newell), by a constrained Delaunay triangulation that uses every
    corner, also those on straight edges: the polygon beside it does. Raises: InputError where it crosses itself.
    """
    vertices, corners, sizes = polygons.vertices, polygons.corners, polygons.sizes
    start = np.cumsum(sizes) - sizes
    triangles, quads = np.flatnonzero(sizes == 3), np.flatnonzero(sizes == 4)
    four = corners[start[quads, None] + np.arange(4)]
    blocks = [corners[start[triangles, None] + np.arange(3)], _two_each(vertices, four)]
    owners = [triangles, np.repeat(quads, 2)]
    for p in np.flatnonzero(sizes > 4).tolist():
        part = _by_delaunay(vertices, corners[start[p] : start[p] + sizes[p]], p)
        blocks.append(part)
        owners.append(np.full(len(part), p))
    return np.concatenate(blocks)[np.argsort(np.concatenate(owners), kind="stable")]


def _two_each(vertices: F64, quads: I64) -> I64:
    """(N, 4) -> (2 N, 3)."""
    a, b, c, d = np.moveaxis(vertices[quads], 1, 0)
    normal = np.cross(c - a, d - b)

    def smaller(p: F64, q: F64, r: F64, s: F64) -> F64:
        """Of the areas of pqr and prs, along the normal, times its length."""
        halves = [np.einsum("ni,ni->n", np.cross(e - p, f - p), normal) for e, f in ((q, r), (r, s))]
        return np.asarray(np.minimum(*halves))

    one, other = smaller(a, b, c, d), smaller(b, c, d, a)
    better = other > one + AREA_SHARE * np.abs(one)
    first, second = np.array([[0, 1, 2], [0, 2, 3]]), np.array([[1, 2, 3], [1, 3, 0]])
    return np.where(better[:, None, None], quads[:, second], quads[:, first]).reshape(-1, 3)


def _by_delaunay(vertices: F64, corners: I64, polygon: int) -> I64:
    """The triangles of one polygon. A corner that it passes twice, where a bridge leads to a hole, counts once."""
    points = vertices[corners]
    points = points - points.mean(axis=0)
    following = np.roll(points, -1, axis=0)
    normal = 0.5 * np.cross(points, following).sum(axis=0)
    area = float(np.linalg.norm(normal))
    spread = float(np.abs(points).max())
    if area <= FLAT * spread**2:  # no plane, no area: triangles that keep its edges joined, and go later
        return np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], axis=1)
    x = np.linalg.svd(normal[None, :])[2][1]
    y = np.cross(normal / area, x)
    unique, first, same = np.unique(points, axis=0, return_index=True, return_inverse=True)
    loop = same.ravel()
    edges, count = np.unique(np.sort(np.stack([loop, np.roll(loop, -1)], axis=1), axis=1), axis=0, return_counts=True)
    edges = edges[(count % 2 == 1) & (edges[:, 0] != edges[:, 1])]
    flat = unique @ np.stack([x, y], axis=1) / spread
    try:
        faces = gpytoolbox.triangulate_polygon(flat, edges, q=0.0)[1].astype(np.int64)
        a, b, c = np.moveaxis(flat[faces], 1, 0)
    except (ValueError, RuntimeError, IndexError):  # it crosses itself: refused, or cut where it does
        doubled = np.zeros(1)
    else:
        doubled = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    if doubled.min() < -AREA_SHARE or abs(0.5 * doubled.sum() * spread**2 / area - 1) > AREA_SHARE:
        remedy = "let the program that wrote the file triangulate it"
        raise InputError(f"its polygon {polygon} of {len(corners)} corners crosses itself", remedy=remedy)
    return np.asarray(corners[first][faces])
