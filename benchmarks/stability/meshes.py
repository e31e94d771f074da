"""Meshes: slivers, duplicates, thin sheets, what is no solid; remeshing and rays at either end of a rig's range."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh

from benchmarks.stability.case import Ends, Family, relative
from hw.base.arrays import F64, I64
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.mesh_file import read_scan
from pipeline.geometry.remesh import is_sound, remesh

FAMILY = Family("meshes")
Change = Callable[[F64, I64], tuple[F64, I64]]


def solid(size: float = 40.0) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=3, radius=size / 2)


def through_a_file(change: Change) -> trimesh.Trimesh:
    """A ball with its arrays changed, written and read as a scan is."""
    mesh = solid()
    points, faces = change(np.array(mesh.vertices), np.array(mesh.faces))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scan.ply"
        trimesh.Trimesh(points, faces, process=False).export(path)
        return read_scan(path)


def volume_off(change: Change) -> float:
    return relative(through_a_file(change).volume, solid().volume)


def soup(points: F64, faces: I64) -> tuple[F64, I64]:
    return points[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)


def doubled(points: F64, faces: I64) -> tuple[F64, I64]:
    again = np.concatenate([points, points])
    changed = faces.copy()
    changed[::2] += len(points)
    return again, changed


def with_slivers(points: F64, faces: I64) -> tuple[F64, I64]:
    """A vertex in the middle of an edge, with two triangles of no area."""
    a, b, _ = faces[0]
    points = np.concatenate([points, [(points[a] + points[b]) / 2]])
    return points, np.concatenate([faces, [[a, len(points) - 1, b], [b, len(points) - 1, a]]])


def three_at_an_edge(points: F64, faces: I64) -> tuple[F64, I64]:
    a, b, _ = faces[0]
    points = np.concatenate([points, [[0.0, 0.0, 60.0]]])
    return points, np.concatenate([faces, [[a, b, len(points) - 1]]])


for name, change, ends, extent in (
    ("every triangle with vertices of its own", soup, Ends.RIGHT, "6 vertices in one place"),
    ("half the triangles on a second copy of the vertices", doubled, Ends.RIGHT, "2 vertices in one place"),
    ("triangles without area", with_slivers, Ends.EITHER, "height 0"),
    ("a vertex that no triangle has", lambda p, f: (np.vstack([p, [[0, 0, 0]]]), f), Ends.RIGHT, "1 of 643"),
    ("three triangles at an edge", three_at_an_edge, Ends.REFUSED, "no surface of a solid"),
    ("a hole", lambda p, f: (p, f[1:]), Ends.REFUSED, "1 triangle"),
    ("inside out", lambda p, f: (p, f[:, ::-1]), Ends.REFUSED, "volume below 0"),
    ("a triangle turned round", lambda p, f: (p, np.concatenate([f[:1, ::-1], f[1:]])), Ends.REFUSED, "1 of 1280"),
    ("no triangles", lambda p, f: (p, f[:0]), Ends.REFUSED, "0"),
    (
        "coordinates that are not finite",
        lambda p, f: (np.where(np.arange(len(p))[:, None] == 3, np.nan, p), f),
        Ends.REFUSED,
        "NaN",
    ),
    ("coordinates of 1e30", lambda p, f: (p * 1e30, f), Ends.REFUSED, "1e31 mm"),
    ("a millimetre's thousandth", lambda p, f: (p * 1e-4, f), Ends.REFUSED, ".004 mm"),
    ("a sheet of a ten-thousandth", lambda p, f: (p * [1, 1, 1e-4], f), Ends.REFUSED, "1e-4 of its size"),
    ("far from the origin", lambda p, f: (p + 1e6, f), Ends.EITHER, "coordinates 1e6 mm"),
):
    FAMILY.case(f"a scan: {name}", "the ball's volume to 1e-4", extent, 1e-4, ends=ends)(partial(volume_off, change))


def rays_off(size: float, far: float = 0.0) -> float:
    """Largest miss of first hits from the plane of the triangle, and of barycentric weights from 1, in sizes."""
    mesh = solid(size)
    mesh.apply_translation([far, far, far])
    rng = np.random.default_rng(0)
    towards = rng.standard_normal((2000, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    origins = np.full((2000, 3), far) - 10 * size * towards
    hits = RayMesh.of(mesh).first_hit(origins, towards)
    if (hits.triangle < 0).any():
        return np.inf
    place = RayMesh.of(mesh).points(hits.triangle, hits.barycentric)
    return float(np.linalg.norm(place - (origins + hits.distance[:, None] * towards), axis=1).max() / size)


for size, far in ((1.0, 0.0), (40.0, 0.0), (300.0, 0.0), (2000.0, 0.0), (40.0, 1e3)):
    FAMILY.case(
        f"rays at a ball of {size:g} mm, {far:g} mm off",
        "hits on the triangles, to 1e-5 of the size",
        f"{size:g} mm, coordinates {far:g} mm",
        1e-5,
    )(partial(rays_off, size, far))


def shadows_wrong(size: float) -> float:
    """How many points of a ball are in the shadow of their own triangle, or not in the ball's."""
    mesh = solid(size)
    surface = RayMesh.of(mesh)
    vars(surface)["free"] = np.zeros(len(surface.faces), bool)  # ask every ray
    try:
        face, middle = np.arange(len(surface.faces)), surface.corners.mean(axis=1)
        lit = surface.blocked(face, middle, surface.normals)
        return float(lit.sum() + (~surface.blocked(face, middle, -surface.normals)).sum())
    finally:
        del vars(surface)["free"]


for size in (1.0, 300.0, 2000.0):
    FAMILY.case(f"shadows on a ball of {size:g} mm", "none of a triangle's own, the ball's everywhere", f"{size:g} mm")(
        partial(shadows_wrong, size)
    )


def remeshed_off(mesh: trimesh.Trimesh, vertices: int) -> float:
    """Of the volume; not finite where the mesh is not sound."""
    out = remesh(mesh, vertices)
    return relative(out.volume, mesh.volume) if is_sound(out, mesh) else np.nan


def ball_remeshed_off(size: float) -> float:
    return remeshed_off(solid(size), 162)


for size in (1.0, 300.0):
    FAMILY.case(f"remeshing a ball of {size:g} mm", "sound, its volume to a per cent", f"{size:g} mm", 0.01, slow=True)(
        partial(ball_remeshed_off, size)
    )
FAMILY.case("remeshing a needle", "sound, its volume to 3 %, or refused", "1 : 40", 0.03, ends=Ends.EITHER, slow=True)(
    lambda: remeshed_off(trimesh.Trimesh(solid().vertices * [0.025, 0.025, 1], solid().faces, process=False), 162)
)
FAMILY.case(
    "remeshing to next to nothing",
    "refused: so few do not resolve it",
    "6 vertices of a torus",
    ends=Ends.REFUSED,
    slow=True,
)(lambda: remeshed_off(trimesh.creation.torus(20, 5), 6))
