"""Tetrahedra that fill a scan, its vertices among theirs.

A Delaunay triangulation of the scan's vertices and of a lattice inside, less what lies outside: unlike meshers that
keep every triangle of the surface it cannot fail where a scan folds into itself, and unlike a grid it does not join
parts that face each other across a gap. The surface itself stays the scan's own triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import Delaunay, QhullError, cKDTree

from hw.base.arrays import F64, I64
from pipeline.reconstruct.samples.distances import hat_points

SPACING = 1.6  # of the cubic lattices inside, in edges of the scan
CLEAR = 0.5  # edges between the lattice and the surface
FLAT = 1e-4  # volume of a tetrahedron that counts, in cubes of its own longest side at a corner


class NoMedium(Exception):
    """Why no medium is fitted."""


@dataclass(frozen=True)
class Tetrahedra:
    """points: (N, 3) mm, the scan's V vertices first; corners: (T, 4) point numbers; volumes: (T,) mm^3;
    gradients: (T, 3, 4) of the linear functions that are 1 at one corner, 1/mm
    """

    points: F64
    corners: I64
    volumes: F64
    gradients: F64


def fill(mesh: trimesh.Trimesh) -> Tetrahedra:
    """The inside of a closed mesh. Raises: NoMedium where its points span no tetrahedra."""
    vertices, edge = np.asarray(mesh.vertices, np.float64), float(mesh.edges_unique_length.mean())
    step = SPACING * edge
    axes = [np.arange(low, high, step) for low, high in zip(*mesh.bounds, strict=True)]
    cubic = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    lattice = np.concatenate([cubic, cubic + 0.5 * step])  # body-centred
    lattice = lattice[_inside(mesh, lattice)]
    if len(lattice):
        lattice = lattice[cKDTree(hat_points(mesh, 4).points).query(lattice)[0] > CLEAR * edge]
    points = np.concatenate([vertices, lattice])
    try:
        corners = np.asarray(Delaunay(points).simplices, np.int64)
    except QhullError:
        raise NoMedium("the scan's points span no tetrahedra") from None
    corners = corners[_inside(mesh, points[corners].mean(axis=1))]
    sides = points[corners[:, 1:]] - points[corners[:, :1]]
    signed = np.linalg.det(sides) / 6.0
    kept = np.abs(signed) > FLAT * np.linalg.norm(sides, axis=2).max(axis=1) ** 3
    corners, volumes = corners[kept], np.abs(signed[kept])
    others = np.linalg.inv(sides[kept])  # (T, 3, 3): gradients of the functions of the last three corners
    gradients = np.concatenate([-others.sum(axis=2, keepdims=True), others], axis=2)
    return Tetrahedra(points, corners, volumes, gradients)


def _inside(mesh: trimesh.Trimesh, points: F64) -> I64:
    return np.flatnonzero(mesh.contains(points)) if len(points) else np.zeros(0, np.int64)
