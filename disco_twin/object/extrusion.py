"""Prisms with sharp edges and holes, as closed meshes of nearly equal triangles."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import trimesh
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from disco_twin.scene.polygons import distance_to_sides, inside, sides
from disco_twin.scene.shape_schema import Extrusion
from hw.base.arrays import F64, I64
from hw.base.errors import InputError

CLEARANCE = 0.6  # of an edge: points inside the outline keep so far from its sides


def extrusion(config: Extrusion, triangles: int = 20_000) -> trimesh.Trimesh:
    """Both ends are cut into triangles alike, the sides into lattices of squares; every edge of the prism stays sharp.

    Raises: InputError where corners or walls are too fine for so many triangles.
    """
    rings = [_turning_left(np.array(config.outline_mm), True)]
    rings += [_turning_left(np.array(hole), False) for hole in config.holes_mm]
    area = sum(_signed_area(ring) for ring in rings)
    around = sum(float(np.linalg.norm(np.diff(sides(ring), axis=1), axis=2).sum()) for ring in rings)
    edge = float(np.sqrt((2 * area + around * config.height_mm) / triangles * 4 / np.sqrt(3)))
    rings = [_divided(ring, edge) for ring in rings]
    plane, cap = _cap(rings, edge)
    layers = max(1, round(config.height_mm / edge))
    rim = sum(len(ring) for ring in rings)  # the plane's first points, ring by ring
    points = [np.column_stack([plane, np.full(len(plane), -config.height_mm / 2)])]
    start = [0]
    for layer in range(1, layers + 1):
        start.append(start[-1] + len(points[-1]))
        level = plane if layer == layers else plane[:rim]
        points.append(np.column_stack([level, np.full(len(level), (layer / layers - 0.5) * config.height_mm)]))
    faces = [cap[:, ::-1], cap + start[-1]]
    here = np.arange(rim)
    following = np.concatenate([np.roll(part, -1) for part in np.split(here, np.cumsum([len(r) for r in rings])[:-1])])
    for low, high in pairwise(start):
        faces.append(np.column_stack([low + here, low + following, high + following]))
        faces.append(np.column_stack([low + here, high + following, high + here]))
    turned = Rotation.from_euler("xyz", config.turn_deg, degrees=True).apply(np.concatenate(points))
    return trimesh.Trimesh(turned, np.concatenate(faces), process=False)


def _signed_area(ring: F64) -> float:
    """mm^2, positive where the ring runs counter-clockwise."""
    following = np.roll(ring, -1, axis=0)
    return float((ring[:, 0] * following[:, 1] - ring[:, 1] * following[:, 0]).sum()) / 2


def _turning_left(ring: F64, left: bool) -> F64:
    return ring if (_signed_area(ring) > 0) == left else ring[::-1]


def _divided(ring: F64, edge: float) -> F64:
    """The ring with every side cut into equal parts of about `edge`."""
    parts = []
    for start, end in sides(ring):
        count = max(1, round(float(np.linalg.norm(end - start)) / edge))
        parts.append(start + (np.arange(count) / count)[:, None] * (end - start))
    return np.concatenate(parts)


def _cap(rings: list[F64], edge: float) -> tuple[F64, I64]:
    """(N, 2) points, those of the rings first, and (F, 3) counter-clockwise triangles of the plane between the rings.

    Delaunay's, of a lattice inside: they keep to the rings where no other point lies in the circle over a ring's side.
    """
    rim = np.concatenate(rings)
    low, high = rim.min(axis=0), rim.max(axis=0)
    rise = edge * np.sqrt(3) / 2
    rows = int(np.ceil((high[1] - low[1]) / rise)) + 1
    columns = int(np.ceil((high[0] - low[0]) / edge)) + 2
    j, i = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    lattice = np.column_stack([(low[0] + (i - 0.5 * (j % 2)) * edge).ravel(), (low[1] + j * rise).ravel()])
    lattice = lattice[inside(lattice, rings)]
    points = np.concatenate([rim, lattice[distance_to_sides(lattice, rings) > CLEARANCE * edge]])
    triangles = np.asarray(Delaunay(points).simplices, np.int64)
    corners = points[triangles]
    triangles = triangles[inside(corners.mean(axis=1), rings)]
    a, b, c = points[triangles].transpose(1, 0, 2)
    left = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]) > 0
    triangles[~left] = triangles[~left][:, ::-1]
    directed = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    found = {(int(u), int(v)) for u, v in directed}
    border = {(u, v) for u, v in found if (v, u) not in found}
    first = np.cumsum([0, *(len(ring) for ring in rings)])
    wanted = {
        (int(u), int(u + 1 if u + 1 < end else begin)) for begin, end in pairwise(first) for u in range(begin, end)
    }
    if border != wanted:
        problem = f"a corner or a wall is too fine for triangles with edges of {edge:.2g} mm"
        raise InputError(problem, key="object.shape", remedy="keep sides of outline and holes two edges apart")
    return points, triangles
