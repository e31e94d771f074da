"""Poses from silhouettes: from afar, of what has no edges, of another object, of a body alike from all sides."""

from __future__ import annotations

from functools import cache, partial

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from benchmarks.stability.case import Ends, Family
from hw.base.arrays import F64
from pipeline.calibrate.pose import PoseFit, fit_poses
from pipeline.geometry.camera import PinholeCamera, look_at, turn
from pipeline.geometry.silhouette import mesh_mask

FAMILY = Family("poses")
SIGMA = 4.5
ANGLES = (0.0, 2.1, 4.2)
FINER = 4  # parts of a pixel, per axis, that a silhouette is averaged over


@cache
def lump() -> trimesh.Trimesh:
    """Irregular, 40 mm large."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=15.0)
    p = np.asarray(mesh.vertices)
    bumps = 1 + 0.25 * np.sin(p[:, :1] / 5 + 1) * np.cos(p[:, 1:2] / 6) + 0.15 * np.sin(p[:, 2:] / 4)
    return trimesh.Trimesh(p * bumps * [1.2, 0.9, 1.0], mesh.faces, process=False)


def camera(scale: int = 1) -> PinholeCamera:
    pose = look_at((450.0, 0.0, 60.0), (0, 0, 0))
    size = 160 * scale
    return PinholeCamera(size, size, np.full(2, 1200.0 * scale), np.full(2, size / 2), np.zeros(5), pose)


def displaced(degrees: float, mm: float) -> F64:
    """(4, 4) of an object that stands elsewhere than it should."""
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(np.deg2rad(degrees) * np.array([0.6, 0.64, 0.48])).as_matrix()
    out[:3, 3] = mm * np.array([0.6, -0.64, 0.48])
    return out


def silhouettes(mesh: trimesh.Trimesh, place: F64) -> list[NDArray[np.float64]]:
    """Images of the object under even light, one an angle, with a blur of half a pixel and noise of a hundredth."""
    rng, out = np.random.default_rng(0), []
    for angle in ANGLES:
        fine = mesh_mask(mesh, camera(FINER).seen_from(place @ turn(angle))).astype(float)
        image = fine.reshape(160, FINER, 160, FINER).mean(axis=(1, 3))
        out.append(ndimage.gaussian_filter(image, 0.5) + 0.01 * rng.standard_normal(image.shape))
    return out


def fitted(mesh: trimesh.Trimesh, images: list[NDArray[np.float64]]) -> PoseFit:
    return fit_poses(images, mesh, [camera()], ANGLES)


def off(degrees: float, mm: float) -> float:
    """Pixels by which the object's vertices are seen elsewhere than they are, root mean square."""
    place = displaced(degrees, mm)
    found = fitted(lump(), silhouettes(lump(), place))
    miss = []
    for view, angle in zip(found.views, ANGLES, strict=True):
        true = camera().seen_from(place @ turn(angle))
        miss.append(view.project(np.asarray(lump().vertices))[0] - true.project(np.asarray(lump().vertices))[0])
    return float(np.sqrt((np.concatenate(miss) ** 2).sum(axis=1).mean()))


for degrees, mm in ((0.0, 0.0), (4.0, 10.0), (9.0, 25.0)):
    FAMILY.case(
        f"an object {degrees:g} degrees and {mm:g} mm off",
        "its vertices are seen within .2 pixels of where they are",
        f"{degrees:g} degrees, {mm:g} mm",
        0.2,
        slow=True,
    )(partial(off, degrees, mm))


def of_images(change: str) -> float:
    """A pose from images that show no such object."""
    image = {"black": 0.0, "white": 1.0, "not finite": np.nan}[change]
    return float(fitted(lump(), [np.full((160, 160), image)] * len(ANGLES)).edges)


for change in ("black", "white", "not finite"):
    FAMILY.case(f"images that are all {change}", "refused: no edge", "no silhouette", ends=Ends.REFUSED, slow=True)(
        partial(of_images, change)
    )


@FAMILY.case("a ball", "told: its rotations stay open", "looks alike from all sides", slow=True)
def ball() -> float:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=15.0)
    found = fitted(mesh, silhouettes(mesh, displaced(4.0, 5.0)))
    return float(not any("rotation" in line for line in found.ambiguity))


@FAMILY.case(
    "another object's silhouettes",
    "refused, or told as edges pixels off",
    "a box for a lump",
    ends=Ends.EITHER,
    slow=True,
)
def another() -> float:
    found = fitted(lump(), silhouettes(trimesh.creation.box((50.0, 20.0, 14.0)), np.eye(4)))
    share = sum(found.xor_pixels) / sum(mesh_mask(lump(), view).sum() for view in found.views)
    return float(share < 0.03)
