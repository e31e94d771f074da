"""`disco-twin mesh`: a closed, outward oriented mesh from a scan with holes, edges of many triangles and loose pieces.

MeshFix (Attene 2010) does it, body by body: it leaves the surface alone where it is sound. It is optional, and why it
and no other: docs/decisions/0107-mesh-files.md.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy import sparse
from scipy.spatial import cKDTree

from disco_twin.object.mesh import check_mesh, crossing, distance_to
from hw.base.arrays import F64, I64
from hw.base.errors import DiscoError, InputError
from hw.base.files import write_atomically
from pipeline.geometry.mesh_file import LARGEST_MM, SMALLEST_MM, load_mesh

LOOKED_AT = 200  # vertices of a body, to see whether it lies inside another one
LEAST_SHARE = 0.01  # of the largest piece's area, below which a piece is dropped
MOST_PIECES = 200  # beyond which there are no pieces, but triangles that have lost each other
CRACK = 1 / 30  # of the size: pieces whose borders come nearer are one body
JOINED = 1e-6  # of the size: vertices of an open mesh that are nearer become one
ROUNDS, INNER_ROUNDS = 10, 3  # of removing triangles that cross others, and closing what that opens: MeshFix's own
BY_VOXELS = "remesh it with voxels in Blender or MeshLab, which keeps shape alone"


@dataclass(frozen=True)
class Mended:
    """What was changed. Lengths in mm, after scaling."""

    triangles: tuple[int, int]  # before, after
    repeated_triangles: int  # left out: the same three vertices as another
    bad_edges: int  # that did not join two triangles
    holes: int  # closed; those that taking out triangles had left are among them
    turned: bool  # some triangles were oriented inwards
    bodies: int  # that do not touch
    pieces_dropped: int
    dropped_share: float  # of the area
    scale: float
    shift_mm: tuple[float, float, float]  # after scaling
    size_mm: float
    volume_mm3: float
    off_mm: float  # largest distance of the new surface from the old one: inside closed holes
    lost_mm: float  # largest distance of the old surface, without dropped pieces, from the new one

    def lines(self) -> list[tuple[str, str]]:
        """Name and figure, to be printed."""
        x, y, z = self.shift_mm
        return [
            ("triangles", f"{self.triangles[0]} -> {self.triangles[1]}, {self.repeated_triangles} repeated ones out"),
            ("edges", f"{self.bad_edges} did not join two triangles"),
            ("holes", f"{self.holes} closed"),
            ("orientation", "turned outward" if self.turned else "kept"),
            ("pieces", f"{self.pieces_dropped} dropped, {self.dropped_share:.2%} of the area"),
            ("bodies", f"{self.bodies}"),
            ("surface", f"new at most {self.off_mm:.3g} mm from old, old at most {self.lost_mm:.3g} mm from new"),
            ("scale", f"{self.scale:.6g}, then shifted by {x:.4g}, {y:.4g}, {z:.4g} mm"),
            ("result", f"{self.size_mm:.4g} mm large, {self.volume_mm3:.5g} mm^3"),
        ]


def mend(path: Path, out: Path, size_mm: float | None) -> Mended:
    """Write the mended mesh to `out`, a PLY file that is not there yet.

    size_mm: its largest extent; it is then centred on the origin. Left out, size and place are kept, since a scan
    stands where the turntable had it. Raises: InputError where no solid comes out, or for files that cannot be.
    """
    if out.suffix.lower() != ".ply":
        raise InputError("the mended mesh is written as PLY", file=out, allowed=".ply", remedy="name it .ply")
    if out.exists():
        raise InputError("is there already", file=out, remedy="delete it, or choose another name")
    if size_mm is not None and not SMALLEST_MM <= size_mm <= LARGEST_MM:
        allowed, remedy = f"{SMALLEST_MM:g} .. {LARGEST_MM:g}", "choose another size"
        raise InputError("no rig can scan that", key="--size-mm", value=size_mm, allowed=allowed, remedy=remedy)
    old = load_mesh(path)
    kept, repeated, dropped, share = _pieces(old, path)
    mended, holes = zip(*(_closed(body, path) for body in _bodies(kept)), strict=True)
    whole = trimesh.util.concatenate(_oriented(mended, path))
    scale = 1.0 if size_mm is None else size_mm / float(whole.extents.max())
    shift = np.zeros(3) if size_mm is None else -scale * whole.bounds.mean(axis=0)
    placed = (scale * np.asarray(whole.vertices) + shift).astype(np.float32)  # as the file holds them
    new = trimesh.Trimesh(placed, whole.faces, process=False)
    try:
        check_mesh(new, path)
    except InputError as error:
        instead = error.remedy if error.allowed else BY_VOXELS  # what is about size has a remedy of its own
        raise error.amended(problem=f"mended, {error.problem}", key=None, remedy=instead) from error
    write_atomically(out, bytes(new.export(file_type="ply")))
    before = trimesh.util.concatenate(kept)
    before.vertices = scale * np.asarray(before.vertices) + shift
    edges = np.unique(old.edges_sorted, axis=0, return_counts=True)[1]
    return Mended(
        triangles=(len(old.faces), len(new.faces)),
        repeated_triangles=repeated,
        bad_edges=int((edges != 2).sum()),
        holes=sum(holes),
        turned=bool(not old.is_winding_consistent or old.volume < 0),
        bodies=len(mended),
        pieces_dropped=dropped,
        dropped_share=share,
        scale=scale,
        shift_mm=(float(shift[0]), float(shift[1]), float(shift[2])),
        size_mm=float(new.extents.max()),
        volume_mm3=float(new.volume),
        off_mm=_farthest(new, before),
        lost_mm=_farthest(before, new),
    )


def _pieces(mesh: trimesh.Trimesh, path: Path) -> tuple[list[trimesh.Trimesh], int, int, float]:
    """What hangs together by edges, as soon as vertices that hardly differ are one; without repeated triangles.

    Returns the pieces, how many triangles were repeated, how many pieces were dropped, and their share of the area.
    Raises: InputError.
    """
    points, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)
    if not mesh.is_watertight:
        pairs = cKDTree(points).query_pairs(JOINED * float(mesh.extents.max()), output_type="ndarray")
        label = _groups(len(points), pairs)
        faces = np.unique(label, return_index=True)[1][label][faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    if not len(faces):
        raise InputError("encloses nothing", file=path, remedy=BY_VOXELS)
    first = np.sort(np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1])
    pieces, shares = _by_edges(points, faces[first])
    large = shares >= LEAST_SHARE * shares.max()
    if large.sum() > MOST_PIECES:
        remedy = "merge vertices by distance in the program that made it, then repeat the command"
        raise InputError(f"falls into {large.sum()} pieces that share no edge", file=path, remedy=remedy)
    kept = [piece for piece, keep in zip(pieces, large, strict=True) if keep]
    return kept, len(faces) - len(first), int((~large).sum()), float(shares[~large].sum())


def _by_edges(points: F64, faces: I64) -> tuple[list[trimesh.Trimesh], F64]:
    """The pieces of triangles that share edges, and each one's share of the area."""
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edge = np.unique(ends, axis=0, return_inverse=True)[1].reshape(-1, 3)
    label = _groups(int(edge.max()) + 1, np.concatenate([edge[:, :2], edge[:, 1:]]))[edge[:, 0]]
    label = np.unique(label, return_inverse=True)[1]
    areas = np.bincount(label, trimesh.triangles.area(points[faces]))
    order = np.split(np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))[:-1])
    pieces = [trimesh.Trimesh(points, faces[own], process=False) for own in order]
    for piece in pieces:
        piece.remove_unreferenced_vertices()
    return pieces, areas / areas.sum()


def _groups(count: int, pairs: I64) -> I64:
    """(count,) the group of each of `count` things, of which pairs belong together."""
    graph = sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return np.asarray(sparse.csgraph.connected_components(graph, directed=False)[1], np.int64)


def _bodies(pieces: list[trimesh.Trimesh]) -> list[list[trimesh.Trimesh]]:
    """Pieces that are one surface: open ones whose borders come near each other, as along a crack."""
    size = float(np.ptp(np.concatenate([p.bounds for p in pieces]), axis=0).max())
    borders = []
    for piece in pieces:
        edges, count = np.unique(piece.edges_sorted, axis=0, return_counts=True)
        borders.append(np.asarray(piece.vertices)[np.unique(edges[count != 2])])
    near = [
        (i, j)
        for i, j in itertools.combinations([k for k, border in enumerate(borders) if len(border)], 2)
        if np.min(cKDTree(borders[i]).query(borders[j])[0]) < CRACK * size
    ]
    label = _groups(len(pieces), np.array(near, np.int64).reshape(-1, 2))
    return [[piece for piece, own in zip(pieces, label, strict=True) if own == body] for body in np.unique(label)]


def _closed(pieces: list[trimesh.Trimesh], path: Path) -> tuple[trimesh.Trimesh, int]:
    """One body, closed, and how many holes that took. Raises: DiscoError without MeshFix; InputError."""
    (piece, *others) = pieces
    if not others and piece.is_watertight and piece.is_winding_consistent and crossing(piece) is None:
        return piece, 0
    try:
        from pymeshfix import PyTMesh
    except ImportError as error:
        raise DiscoError("mending a mesh needs pymeshfix. Remedy: pip install 'disco-twin[mesh]'") from error

    def meshfix(mesh: trimesh.Trimesh) -> Any:
        work = PyTMesh()
        work.set_quiet(True)
        work.load_array(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int32))
        return work

    points, triangles = meshfix(trimesh.util.concatenate(pieces)).return_arrays()
    if not len(triangles):
        raise InputError("encloses nothing", file=path, remedy=BY_VOXELS)
    cut, shares = _by_edges(points, triangles)  # where more than two meet
    cut = [part for part, share in zip(cut, shares, strict=True) if share >= LEAST_SHARE * shares.max()]  # without fins
    work = meshfix(trimesh.util.concatenate(cut))
    if len(cut) > 1:
        work.join_closest_components()
    holes = int(work.fill_small_boundaries(0, True))  # of any size, with triangles like those around
    if not work.clean(ROUNDS, INNER_ROUNDS):
        raise InputError("its triangles still cross each other after mending", file=path, remedy=BY_VOXELS)
    vertices, faces = work.return_arrays()
    if not len(faces):
        raise InputError("encloses nothing", file=path, remedy=BY_VOXELS)
    return trimesh.Trimesh(vertices, faces, process=False), holes


def _oriented(parts: Sequence[trimesh.Trimesh], path: Path) -> list[trimesh.Trimesh]:
    """Outward, or inward where one lies inside another: a cavity. Raises: InputError for bodies that overlap."""
    for part in parts:
        points, around = np.asarray(part.vertices)[:: max(1, len(part.vertices) // LOOKED_AT)], 0
        for other in parts:
            inside = np.asarray(other.contains(points)) if other is not part else np.zeros(1, bool)
            if inside.any() and not inside.all():
                raise InputError("two of its bodies overlap", file=path, remedy=BY_VOXELS)
            around += bool(inside.all())
        if (part.volume < 0) != (around % 2 == 1):
            part.invert()
    return list(parts)


def _farthest(of: trimesh.Trimesh, to: trimesh.Trimesh) -> float:
    """Largest distance in mm of the vertices and the triangles' middles of one surface from another."""
    points = np.concatenate([np.asarray(of.vertices), np.asarray(of.triangles_center)])
    return float(distance_to(to, points).max())
