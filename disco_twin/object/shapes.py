"""Procedural shapes as fine, closed, outward oriented triangle meshes in mm."""

from __future__ import annotations

import numpy as np
import trimesh

from disco_twin.scene.shape_schema import Box, Pebble, Sphere, Torus
from hw.base.arrays import F64, I64

SUBDIVISIONS = 5  # of an icosahedron: 10242 vertices, 20480 triangles
DENTS = np.array([[0.55, -0.75, 0.35], [-0.6, 0.5, 0.62]])  # directions of the pebble's two concave dents


def pebble(config: Pebble) -> trimesh.Trimesh:
    """r(d) = (1 + bumps - dents) over the directions d, each a von Mises-Fisher lobe, then scaled to `size_mm`."""
    random = np.random.default_rng(config.seed)
    mesh = trimesh.creation.icosphere(subdivisions=SUBDIVISIONS)
    d = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    bumps = random.normal(size=(9, 3))
    radius = np.ones(len(d))
    for centre, height in zip(bumps, random.uniform(0.08, 0.18, len(bumps)), strict=True):
        radius += height * _lobe(d, centre, 10.0)
    for centre, depth in zip(DENTS, (0.45, 0.36), strict=True):
        radius -= depth * _lobe(d, centre, 7.0)
    points = d * radius[:, None]
    low, high = points.min(axis=0), points.max(axis=0)
    points = ((points - low) / (high - low) - 0.5) * np.array(config.size_mm)
    return trimesh.Trimesh(points, mesh.faces, process=False)


def _lobe(d: F64, centre: F64, sharpness: float) -> F64:
    """(N, 3) unit directions -> (N,) bell around `centre`, 1 at its peak."""
    return np.asarray(np.exp(sharpness * (d @ (centre / np.linalg.norm(centre)) - 1)))


def sphere(config: Sphere) -> trimesh.Trimesh:
    """An icosphere whose vertices lie on the sphere."""
    return trimesh.creation.icosphere(subdivisions=SUBDIVISIONS, radius=config.radius_mm)


def torus(config: Torus) -> trimesh.Trimesh:
    """Triangles of about equal edges around the ring."""
    minor = int(np.ceil(np.sqrt(10_000 * config.tube_radius_mm / config.ring_radius_mm)))
    return trimesh.creation.torus(
        config.ring_radius_mm, config.tube_radius_mm, major_sections=10_000 // minor, minor_sections=minor
    )


def box(config: Box, triangles: int = 20_000) -> trimesh.Trimesh:
    """Each face is a lattice of squares cut into two triangles."""
    size = np.array(config.size_mm)
    area = 2 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
    cells = np.maximum(1, np.round(size / np.sqrt(2 * area / triangles))).astype(int)
    points: list[I64] = []
    faces: list[I64] = []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, 1):
            i, j = np.meshgrid(np.arange(cells[a] + 1), np.arange(cells[b] + 1), indexing="ij")
            lattice = np.zeros((i.size, 3), dtype=np.int64)
            lattice[:, axis], lattice[:, a], lattice[:, b] = side * cells[axis], i.ravel(), j.ravel()
            k = np.arange(i.size).reshape(i.shape) + sum(len(p) for p in points)
            quads = np.stack([k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]], axis=-1).reshape(-1, 4)
            quads = quads if side else quads[:, ::-1]
            faces += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
            points.append(lattice)
    unique, index = np.unique(np.concatenate(points), axis=0, return_inverse=True)
    return trimesh.Trimesh((unique / cells - 0.5) * size, index.reshape(-1)[np.concatenate(faces)], process=False)
