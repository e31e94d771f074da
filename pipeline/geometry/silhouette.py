"""Silhouettes: where an image shows the object, and where a mesh says that it lies."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage

from hw.base.arrays import F64, Bool
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.mesh import RayMesh


def object_mask(image: NDArray[np.floating], share: float = 0.02) -> Bool:
    """(H, W) the thesis's silhouette: a threshold, between the background and the darkest parts of the object.

    share: of the image that the object fills at least, more or less; its bright half is what the threshold refers to
    """
    image = np.asarray(image, np.float64)
    dark, light = np.percentile(image, 5), np.percentile(image, max(99.0, 100.0 - 50.0 * share))
    return np.asarray(ndimage.binary_opening(image > dark + 0.15 * (light - dark)))


def mesh_mask(mesh: trimesh.Trimesh, camera: PinholeCamera) -> Bool:
    """(H, W) pixels whose centre shows the mesh."""
    return RayMesh.of(mesh).meets(*camera.rays(camera.pixel_centres())).reshape(camera.height, camera.width)


def overlap(one: Bool, other: Bool) -> float:
    """What two masks share, of what either fills (Jaccard's index); 1 for two empty ones."""
    either = np.count_nonzero(one | other)
    return float(np.count_nonzero(one & other) / either) if either else 1.0


def shifted_overlap(one: Bool, other: Bool, most: float) -> float:
    """The overlap when `other` is moved until both masks' centres meet; most: of its own size, that it may be moved."""
    if not one.any() or not other.any():
        return overlap(one, other)
    centres = np.array([np.mean(np.nonzero(one), axis=1), np.mean(np.nonzero(other), axis=1)])
    reach = most * np.sqrt(np.count_nonzero(other))
    rows, columns = np.rint(np.clip(centres[0] - centres[1], -reach, reach)).astype(int)
    moved = ndimage.shift(other.astype(np.uint8), (rows, columns), order=0) > 0
    return max(overlap(one, other), overlap(one, moved))


def pixel_grid(shape: tuple[int, ...], most: int) -> tuple[NDArray[np.intp], NDArray[np.intp], F64]:
    """Rows, columns, and (rows * columns, 2) their pixels' centres: at most `most` each way, symmetric in the image."""
    height, width = shape
    rows = np.rint(np.linspace(0, height - 1, min(height, most))).astype(np.intp)
    columns = np.rint(np.linspace(0, width - 1, min(width, most))).astype(np.intp)
    return rows, columns, np.stack(np.meshgrid(columns + 0.5, rows + 0.5), axis=-1).reshape(-1, 2)
