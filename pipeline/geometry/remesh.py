"""Few triangles of nearly equal area that keep a surface's edges and its size.

Botsch and Kobbelt 2004 with sharp edges held, by gpytoolbox; then the best fit of the flat triangles to the surface.
Measured in docs/decisions/0108-the-remeshed-scan.md.
"""

from __future__ import annotations

import gpytoolbox
import numpy as np
import trimesh
from scipy import sparse
from scipy.spatial import cKDTree

from hw.base.arrays import F64, I64
from hw.base.errors import InputError
from pipeline.geometry.mesh import arrays, closest
from pipeline.geometry.mesh_file import with_area

SHARP = np.deg2rad(40.0)  # between the normals on both sides of an edge that stays one
STARTS = (1, 2, 4)  # triangles to begin with, per triangle that is wanted: where one start folds, another does not
ROUNDS, SEARCHES = 20, 6
COUNT_SHARE, MOST_MISSED = 0.01, 0.1  # by which the number of vertices should miss at most, and may
FITS = 2  # closest points move as the vertices do
SLIVER = 1e-3  # height of a triangle relative to its longest edge
TURNS = 3  # rounds of turning edges beside folded triangles
LEAST_AREA = 0.05  # of the mean, that a triangle may have
MOST_OFF = 0.03  # of the volume, or too much of area: a mesh that misses more does not resolve the object
MOST_FOLDED = 0.01  # of the triangles, where no start leaves none
STIFFNESS = 1e-6  # of the largest: holds what no point of the surface says anything about


def remesh(mesh: trimesh.Trimesh, vertices: int) -> trimesh.Trimesh:
    """About `vertices` vertices near the surface of `mesh`, triangles of nearly equal area, sharp edges kept.

    Flat faces stay where they are. On curved ones, chords between points of a convex surface lie inside it and would
    receive too little light: vertices move outward until area and volume are off by the same share, one too large and
    one too small. Raises: InputError where that many vertices do not resolve the object.
    """
    for sharp in (SHARP, np.inf):  # edges that are too close for so few vertices are rounded
        found: list[tuple[int, trimesh.Trimesh]] = []
        for start in STARTS:
            out = _unfolded(_remeshed(mesh, vertices, start, sharp), mesh)
            if abs(len(out.vertices) / vertices - 1) > MOST_MISSED:
                continue
            fit = _of_its_size(out, mesh) if _closed(out) else out
            if not _closed(fit) or max(fit.area / mesh.area - 1, abs(fit.volume / mesh.volume - 1)) > MOST_OFF:
                continue  # too little area is roughness that was lost
            found.append((len(_folded(fit, mesh)[0]), fit))
            if found[-1][0] == 0:
                return fit
        folded, fit = min(found, key=lambda pair: pair[0], default=(len(mesh.faces), mesh))
        if folded <= MOST_FOLDED * len(fit.faces):
            return fit
    remedy = "raise scan.vertices, or leave it out to hand over the object's own mesh"
    raise InputError("so few do not resolve the object", key="scan.vertices", value=vertices, remedy=remedy)


def _remeshed(mesh: trimesh.Trimesh, vertices: int, start: int, sharp: float) -> trimesh.Trimesh:
    """By quadrics first (Garland and Heckbert 1997), which leave edges and flat faces where they are: Botsch and
    Kobbelt's collapses do not where there are many of them.
    """
    ends = np.asarray(mesh.vertices)[_sharp(mesh, sharp)]
    sharp_points = np.concatenate([ends.reshape(-1, 3), ends.mean(axis=1)])
    if len(mesh.faces) > start * 2 * vertices:
        v, f, *_ = gpytoolbox.decimate(*arrays(mesh), num_faces=start * 2 * vertices, method="qslim")
        mesh = with_area(v, f.astype(np.int64), SLIVER)
    edge = _edge(mesh.area, 2 * vertices)
    out = mesh
    for _ in range(SEARCHES):
        creases, corners = _creases(mesh, edge, sharp, sharp_points)
        v, f = gpytoolbox.remesh_botsch(
            *arrays(mesh), ROUNDS, edge, True, feature=corners.astype(np.int32), feature_edges=creases
        )
        out = trimesh.Trimesh(v, f, process=False)
        if abs(len(v) / vertices - 1) < COUNT_SHARE:
            break
        edge *= float(np.sqrt(len(v) / vertices))
    return out


def _edge(area: float, triangles: int) -> float:
    """Length of an edge in mm where equilateral triangles have that area together."""
    return float(np.sqrt(area / triangles * 4 / np.sqrt(3)))


def _sharp(mesh: trimesh.Trimesh, sharp: float) -> I64:
    """(E, 2) vertices of the edges between triangles that differ by more."""
    return np.asarray(mesh.face_adjacency_edges[mesh.face_adjacency_angles > sharp], np.int64)


def _creases(mesh: trimesh.Trimesh, edge: float, sharp: float, sharp_points: F64) -> tuple[I64, I64]:
    """(E, 2) sharp edges, by their vertices, and (C,) corners: where other than two of them meet, or they bend.

    sharp_points: (N, 3) on sharp edges of the object, from which fewer triangles must not be mistaken for others.
    Sharp edges that hang together count where they are long for the number of their corners, measured by `edge` in mm:
    the noise of a scan makes many short ones.
    """
    points, count = np.asarray(mesh.vertices, np.float64), len(mesh.vertices)
    pairs = _sharp(mesh, sharp)
    if len(pairs):
        pairs = pairs[cKDTree(sharp_points).query(points[pairs].mean(axis=1))[0] < 0.5 * edge]
    along = points[pairs[:, 1]] - points[pairs[:, 0]]
    length = np.linalg.norm(along, axis=1)
    along /= length[:, None]
    degree = np.bincount(pairs.ravel(), minlength=count)
    outgoing = np.zeros((count, 3))  # sum of the unit vectors along the edges: 0 where two of them go straight on
    np.add.at(outgoing, pairs[:, 0], along)
    np.add.at(outgoing, pairs[:, 1], -along)
    bent = np.linalg.norm(outgoing, axis=1) > 2 * np.sin(0.5 * SHARP)
    corner = (degree > 0) & ((degree != 2) | bent)
    graph = sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    label = np.asarray(sparse.csgraph.connected_components(graph, directed=False)[1])
    together = np.bincount(label[pairs[:, 0]], length, minlength=count)
    corners = np.bincount(label[corner], minlength=count)
    counts = together >= edge * (corners + 3)
    return pairs[counts[label[pairs[:, 0]]]], np.flatnonzero(corner & counts[label])


def _closed(mesh: trimesh.Trimesh) -> bool:
    """Closed, outward, and without slivers."""
    areas = np.asarray(mesh.area_faces)
    closed = mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    return bool(closed and areas.min() > LEAST_AREA * areas.mean())


def is_sound(coarse: trimesh.Trimesh, fine: trimesh.Trimesh) -> bool:
    """Closed, outward, without slivers, and nearly nowhere folded over the surface that it stands for."""
    return _closed(coarse) and len(_folded(coarse, fine)[0]) <= MOST_FOLDED * len(coarse.faces)


def _folded(coarse: trimesh.Trimesh, fine: trimesh.Trimesh) -> tuple[I64, F64]:
    """Triangles that face away from the surface below their middle, or nearly have no area; (F, 3) its normals."""
    below = np.asarray(fine.faces)[closest(fine, np.array(coarse.triangles_center))[1]]
    facing = np.asarray(fine.vertex_normals)[below].mean(axis=1)  # one triangle's own may be noise
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    areas = np.asarray(coarse.area_faces)
    toward = areas * (np.asarray(coarse.face_normals) * facing).sum(axis=1)
    return np.flatnonzero(toward <= LEAST_AREA * areas.mean()), facing


def _unfolded(coarse: trimesh.Trimesh, fine: trimesh.Trimesh) -> trimesh.Trimesh:
    """Edges of folded triangles turned where that unfolds them: gpytoolbox turns edges for their ends' valence alone,
    also across a concave corner.
    """
    points = np.asarray(coarse.vertices)
    for _ in range(TURNS):
        folded, facing = _folded(coarse, fine)
        faces, changed = np.array(coarse.faces, np.int64), set[int]()
        sides = {(int(f[k - 1]), int(f[k])): (t, k) for t, f in enumerate(faces) for k in range(3)}

        def area(corners: tuple[int, int, int], normal: F64) -> float:
            a, b, c = points[list(corners)]
            return float(np.cross(b - a, c - a) @ normal)

        for t in folded.tolist():
            best, turned = min(area(tuple(faces[t]), facing[t]), 0.0), None
            for k in range(3):
                a, b, c = (int(v) for v in np.roll(faces[t], 1 - k))  # a to b is the edge
                other, m = sides.get((b, a), (t, 0))
                d = int(faces[other, m - 2])
                if not changed.isdisjoint({t, other}) or other == t or (c, d) in sides or (d, c) in sides:
                    continue
                if facing[t] @ facing[other] < np.cos(SHARP):
                    continue
                two = (c, a, d), (d, b, c)
                least = min(area(corners, facing[other]) for corners in two)
                if least > best:
                    best, turned = least, (other, two)
            if turned is not None:
                faces[t], faces[turned[0]] = turned[1]
                changed |= {t, turned[0]}
        if not changed:
            break
        coarse = trimesh.Trimesh(points, faces, process=False)
    return coarse


def _of_its_size(coarse: trimesh.Trimesh, fine: trimesh.Trimesh) -> trimesh.Trimesh:
    """Moved toward the best fit as far as area and volume are off by as much, with opposite signs."""

    def off(of: trimesh.Trimesh) -> float:
        return float(of.area / fine.area + of.volume / fine.volume - 2)

    middles = np.asarray(fine.vertices)[fine.edges_unique].mean(axis=1)  # a rule of degree 2
    areas = np.repeat(np.asarray(fine.area_faces) / 3.0, 3)
    weight = np.asarray(np.bincount(fine.edges_unique_inverse, areas), np.float64)
    fit = fitted(coarse, middles, weight)
    before, after = off(coarse), off(fit)  # nearly linear between
    share = float(np.clip(before / (before - after), 0.5, 1.0)) if abs(before - after) > 1e-9 else 1.0
    moved = coarse.vertices + share * (fit.vertices - coarse.vertices)
    return trimesh.Trimesh(moved, coarse.faces, process=False)


def fitted(coarse: trimesh.Trimesh, points: F64, weight: F64, stiffness: float = 0.0) -> trimesh.Trimesh:
    """Vertices of `coarse` moved so that the squared distance of (N, 3) points, (N,) weights, from it is least.

    stiffness: of what holds the vertices, as a share of what the points do on average; some where they are noisy
    """
    for _ in range(FITS):
        coarse = _fitted(coarse, points, weight, stiffness)
    return coarse


def _fitted(coarse: trimesh.Trimesh, points: F64, weight: F64, stiffness: float) -> trimesh.Trimesh:
    """Distances are linear in the vertices' places once every point has its closest triangle. A vertex moves along the
    normal where the triangles around it share one, across an edge in two directions, at a corner in all three. Then a
    shift along the normal everywhere changes the sum at no first order: the mean signed distance is 0.
    """
    vertices, faces = arrays(coarse)
    normals, areas = np.asarray(coarse.face_normals), np.asarray(coarse.area_faces)
    spread = np.zeros((len(vertices), 3, 3))  # mean of the outer products of the normals around each vertex
    for k in range(3):
        np.add.at(spread, faces[:, k], areas[:, None, None] * normals[:, :, None] * normals[:, None, :])
    spread /= np.trace(spread, axis1=1, axis2=2)[:, None, None]
    share, direction = np.linalg.eigh(spread)
    direction = direction * (share >= np.sin(0.5 * SHARP) ** 2)[:, None, :]  # (V, 3, 3), columns

    _, triangle, hat = gpytoolbox.squared_distance(points, vertices, faces, use_cpp=True)
    around, normal = faces[triangle], normals[triangle]
    distance = np.einsum("nd,nd->n", points - np.einsum("nk,nkd->nd", hat, vertices[around]), normal)
    moves = hat[:, :, None] * np.einsum("nkde,nd->nke", direction[around], normal)
    columns = 3 * around[:, :, None] + np.arange(3)
    starts = 9 * np.arange(len(points) + 1)
    matrix = sparse.csr_array((moves.ravel(), columns.ravel(), starts), shape=(len(points), 3 * len(vertices)))
    square = (matrix.T @ (matrix * weight[:, None])).tocsc()
    diagonal = square.diagonal()
    held = STIFFNESS * diagonal.max() + stiffness * diagonal.mean()
    square += held * sparse.identity(square.shape[0], format="csc")
    amount = sparse.linalg.spsolve(square, matrix.T @ (weight * distance)).reshape(-1, 3)
    return trimesh.Trimesh(vertices + np.einsum("vde,ve->vd", direction, amount), faces, process=False)
