"""`disco-twin mesh`: a closed, outward oriented mesh from a scan with holes, edges of many triangles and loose pieces.

MeshFix (Attene 2010) does it, piece by piece: it leaves the surface alone where it is sound. It is optional, and why it
and no other: docs/decisions/0107-mesh-files.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy import sparse
from scipy.spatial import cKDTree

from disco_twin.object.mesh import check_mesh, crossing, distance_to
from hw.base.arrays import I64
from hw.base.errors import DiscoError, InputError
from hw.base.files import write_atomically
from pipeline.geometry.mesh_file import LARGEST_MM, SMALLEST_MM, load_mesh

LEAST_SHARE = 0.01  # of the area, below which a piece is dropped
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
    pieces_kept: int
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
            (
                "pieces",
                f"{self.pieces_kept} kept, {self.pieces_dropped} dropped ({self.dropped_share:.2%} of the area)",
            ),
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
    kept, repeated, dropped, share = _pieces(old)
    mended, holes = zip(*(_closed(piece, path) for piece in kept), strict=True)
    whole = trimesh.util.concatenate(_oriented(mended))
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
        turned=not old.is_winding_consistent or old.volume < 0,
        pieces_kept=len(kept),
        pieces_dropped=dropped,
        dropped_share=share,
        scale=scale,
        shift_mm=(float(shift[0]), float(shift[1]), float(shift[2])),
        size_mm=float(new.extents.max()),
        volume_mm3=float(new.volume),
        off_mm=_farthest(new, before),
        lost_mm=_farthest(before, new),
    )


def _pieces(mesh: trimesh.Trimesh) -> tuple[list[trimesh.Trimesh], int, int, float]:
    """What hangs together by vertices, as soon as vertices that hardly differ are one; without repeated triangles.

    Returns the pieces, how many triangles were repeated, how many pieces were dropped, and their share of the area.
    """
    points, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)
    if not mesh.is_watertight:
        pairs = cKDTree(points).query_pairs(JOINED * float(mesh.extents.max()), output_type="ndarray")
        faces = _groups(len(points), pairs)[1][faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    first = np.sort(np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1])
    repeated, faces = len(faces) - len(first), faces[first]
    label = _groups(len(points), np.concatenate([faces[:, :2], faces[:, 1:]]))[0][faces[:, 0]]
    area = np.bincount(label, trimesh.triangles.area(points[faces]))
    share = area / area.sum()
    large = np.flatnonzero(share >= LEAST_SHARE)
    pieces = [trimesh.Trimesh(points, faces[label == k], process=False) for k in large]
    for piece in pieces:
        piece.remove_unreferenced_vertices()
    dropped = np.setdiff1d(np.unique(label), large)
    return pieces, repeated, len(dropped), float(share[dropped].sum())


def _groups(count: int, pairs: I64) -> tuple[I64, I64]:
    """(count,) the group of each of `count` things, of which pairs belong together; (count,) the group's first."""
    graph = sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    label = np.asarray(sparse.csgraph.connected_components(graph, directed=False)[1], np.int64)
    first = np.unique(label, return_index=True)[1]
    return label, first[label]


def _closed(piece: trimesh.Trimesh, path: Path) -> tuple[trimesh.Trimesh, int]:
    """One piece, closed, and how many holes that took. Raises: DiscoError without MeshFix; InputError."""
    if piece.is_watertight and piece.is_winding_consistent and crossing(piece) is None:
        return piece, 0
    try:
        from pymeshfix import PyTMesh
    except ImportError as error:
        raise DiscoError("mending a mesh needs pymeshfix. Remedy: pip install 'disco-twin[mesh]'") from error
    work = PyTMesh()
    work.set_quiet(True)
    work.load_array(np.array(piece.vertices, np.float64), np.array(piece.faces, np.int32))
    work.remove_smallest_components()  # fins that loading has cut off
    holes = int(work.fill_small_boundaries(0, True))  # of any size, with triangles like those around
    if not work.clean(ROUNDS, INNER_ROUNDS):
        raise InputError("its triangles still cross each other after mending", file=path, remedy=BY_VOXELS)
    vertices, faces = work.return_arrays()
    if not len(faces):
        raise InputError("encloses nothing", file=path, remedy=BY_VOXELS)
    return trimesh.Trimesh(vertices, faces, process=False), holes


def _oriented(parts: Sequence[trimesh.Trimesh]) -> list[trimesh.Trimesh]:
    """Outward, or inward where one lies inside another: a cavity."""
    for part in parts:
        around = sum(bool(other.contains(part.vertices[:1])[0]) for other in parts if other is not part)
        if (part.volume < 0) != (around % 2 == 1):
            part.invert()
    return list(parts)


def _farthest(of: trimesh.Trimesh, to: trimesh.Trimesh) -> float:
    """Largest distance in mm of the vertices and the triangles' middles of one surface from another."""
    points = np.concatenate([np.asarray(of.vertices), np.asarray(of.triangles_center)])
    return float(distance_to(to, points).max())
