"""What a device must be able to see before it is worth switching on: checks of a rig against the scanned mesh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from hw.base.errors import InputError
from pipeline.geometry.camera import PinholeCamera, turn
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.nominal_rig import CameraConfig, Point, RigConfig

if TYPE_CHECKING:
    import trimesh

GRID = 128  # rays per axis at most that look for the object in an image
LEAST_PIXELS = 64  # of the object in an image; the rays of the grid stand for the pixels
LEAST_SHARE = 0.25  # of the surface that a vertex of the scan stands for, in an image: R_d is read at the vertices


def require_rig_in_sight(rig: RigConfig, mesh: trimesh.Trimesh) -> None:
    """Cameras and projector stand outside the object at every turntable angle, and every camera sees enough of it.

    Raises: InputError.
    """
    angles = np.deg2rad(rig.turntable_angles_deg)
    for angle in angles:
        _require_outside(rig.projector.position_mm, angle, mesh, "rig.projector", "the projector")
    for i, camera in enumerate(rig.cameras):
        for angle in angles:
            require_in_sight(camera, mesh, f"rig.cameras[{i}]", f"the camera {camera.name!r}", float(angle))


def require_in_sight(config: CameraConfig, mesh: trimesh.Trimesh, key: str, what: str, angle_rad: float = 0.0) -> None:
    """`key`: the camera's table in the scene. Raises: InputError where it is inside the object, or shows too little."""
    _require_outside(config.position_mm, angle_rad, mesh, key, what)
    pixels, surface = _visible(PinholeCamera.from_config(config).seen_from(turn(angle_rad)), mesh)
    at = f" at turntable angle {np.rad2deg(angle_rad):g} deg" if angle_rad else ""
    if not pixels:
        raise InputError(
            f"{what} does not see the object{at}",
            key=f"{key}.aim_mm",
            value=config.aim_mm,
            remedy="aim it at the object, or check position_mm and focal_length_mm",
        )
    if pixels < LEAST_PIXELS:
        raise InputError(
            f"{what} shows the object on about {pixels:.0f} pixels only{at}",
            key=f"{key}.focal_length_mm",
            value=config.focal_length_mm,
            allowed=f"at least {LEAST_PIXELS} pixels of the object",
            remedy="a longer focal_length_mm, a nearer position_mm, or another aim_mm",
        )
    least = LEAST_SHARE * float(mesh.area) / len(mesh.vertices)
    if surface < least:
        raise InputError(
            f"{what} shows {surface:.2g} mm^2 of the object only{at}",
            key=f"{key}.focal_length_mm",
            value=config.focal_length_mm,
            allowed=f"at least {least:.2g} mm^2, the scan resolves no less",
            remedy="a shorter focal_length_mm, a farther position_mm, or another aim_mm",
        )


def warn_of_frame(
    config: CameraConfig, mesh: trimesh.Trimesh, key: str, what: str, angles_rad: Sequence[float] = (0.0,)
) -> str | None:
    """One line where a part of the object lies outside a camera's image at any of these turntable angles; else None.

    That is no error: what one image lacks, others may show. `key`: the camera's table in the scene.
    """
    camera = PinholeCamera.from_config(config)
    shares = np.array([_share_outside(camera.seen_from(turn(angle)), mesh) for angle in angles_rad])
    cut = np.flatnonzero(shares > 0)
    if not len(cut):
        return None
    worst = int(np.argmax(shares))
    share = f"{100 * shares[worst]:.0f} %" if shares[worst] >= 0.01 else "less than 1 %"
    others = f" (and at {len(cut) - 1} more)" if len(cut) > 1 else ""
    return (
        f"{what} does not see the whole object: at turntable angle {np.rad2deg(angles_rad[worst]):g} deg{others} "
        f"{share} of its surface lies outside the image. Remedy: a shorter {key}.focal_length_mm, a farther "
        "position_mm, or another aim_mm"
    )


def _share_outside(camera: PinholeCamera, mesh: trimesh.Trimesh) -> float:
    """Share of the surface whose place in the image plane lies outside the image, whether it is hidden or not."""
    place, depth = camera.project(np.asarray(mesh.vertices, float))
    inside = (depth > 0) & ((place >= 0) & (place <= [camera.width, camera.height])).all(axis=1)  # NaN is outside
    area = np.asarray(mesh.area_faces)
    return float((~inside[mesh.faces]).mean(axis=1) @ area / area.sum())


def _require_outside(position: Point, angle_rad: float, mesh: trimesh.Trimesh, key: str, what: str) -> None:
    place = np.array([position]) @ turn(angle_rad)[:3, :3]  # in the object frame: turned back
    if mesh.contains(place)[0]:
        low, high = mesh.bounds
        raise InputError(
            f"{what} stands inside the object, which spans {np.round(low, 1).tolist()} to {np.round(high, 1).tolist()}",
            key=f"{key}.position_mm",
            value=position,
            remedy="place it outside",
        )


def _visible(camera: PinholeCamera, mesh: trimesh.Trimesh) -> tuple[float, float]:
    """(about how many pixels show the object, mm^2 that they cover across the line of sight)."""
    place, depth = camera.project(np.asarray(mesh.vertices, float))
    size = np.array([camera.width, camera.height], float)
    low, high = np.zeros(2), size
    ahead = depth > 0
    if ((place[ahead] > 0) & (place[ahead] < size)).all(axis=1).any():  # look closer at where it is
        low, high = np.clip(place[ahead].min(axis=0), 0, size), np.clip(place[ahead].max(axis=0), 0, size)
    cells = np.clip(np.ceil(high - low), 1, GRID).astype(int)
    x, y = (low[k] + (np.arange(cells[k]) + 0.5) * (high[k] - low[k]) / cells[k] for k in (0, 1))
    origins, directions = camera.rays(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    distance = RayMesh.of(mesh).first_hit(origins, directions).distance
    met = np.isfinite(distance)
    if not met.any():
        return 0.0, 0.0
    pixels = float(met.mean() * np.prod(high - low))
    width = float(distance[met].mean()) / camera.focal
    return pixels, pixels * float(np.prod(width))
