"""What range scanners and their merging programs leave: holes, fins, repeated and missing triangles, loose pieces."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import cKDTree


def bad_edges(mesh: trimesh.Trimesh) -> float:
    """Share of the edges that do not join two triangles."""
    count = np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1]
    return float((count != 2).mean())


def damaged(mesh: trimesh.Trimesh, seed: int, holes: int = 10, share: float = 0.04) -> trimesh.Trimesh:
    """Ten holes of a thirtieth of the size, and `share` of the edges that do not join two triangles: by triangles that
    are missing, repeated, repeated the other way round, or stand on an edge as a fin; slivers, vertices twice in one
    place, a band of inverted triangles, and three loose pieces.
    """
    random = np.random.default_rng(seed)
    points, faces = np.array(mesh.vertices), np.array(mesh.faces)
    centres = np.asarray(mesh.triangles_center)
    places = centres[random.choice(len(faces), holes, replace=False)]
    near = (np.linalg.norm(centres[:, None] - places, axis=2) < float(mesh.extents.max()) / 60).any(axis=1)
    faces, centres = faces[~near], centres[~near]
    band = np.abs(centres[:, 2] - np.median(centres[:, 2])) < 0.02 * float(mesh.extents.max())
    faces[band] = faces[band][:, ::-1]
    each = int(share * len(mesh.edges_unique) / 3 / 4)
    pick = random.choice(len(faces), 4 * each, replace=False)
    missing, again, inverted, fins = np.split(pick, 4)
    fin = faces[fins].copy()
    fin[:, 2] = cKDTree(points).query(points[fin[:, 2]], k=12)[1][:, -1]  # near, but not beside it
    sliver = np.stack([faces[again, 0], faces[again, 1], faces[again, 1]], axis=1)
    doubled = points[faces[missing[:10], 0]]
    loose = [trimesh.creation.icosphere(1, float(mesh.extents.max()) / 50) for _ in range(3)]
    for piece, at in zip(loose, random.normal(size=(3, 3)), strict=True):
        piece.apply_translation(mesh.bounds[1] * 1.3 + at)
    all_faces = [np.delete(faces, missing, axis=0), faces[again], faces[inverted][:, ::-1], fin, sliver]
    torn = trimesh.Trimesh(np.concatenate([points, doubled]), np.concatenate(all_faces), process=False)
    return trimesh.util.concatenate([torn, *loose])
