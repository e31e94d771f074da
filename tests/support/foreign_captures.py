"""Captures as another laboratory might hand them over: an irregular body, silhouettes and spots where they belong."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from pipeline.capture.import_table import COLUMNS
from pipeline.geometry.camera import PinholeCamera, turn
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.nominal_rig import RigConfig
from pipeline.geometry.projector import TwoMirrorProjector
from pipeline.geometry.silhouette import mesh_mask

WIDTH, HEIGHT = 64, 48
LONGEST, STEPS = 0.02, 3
ANGLES = (0.0, 40.0, 100.0)
DESCRIPTION = f"""
format_version = 1
scan = "scan.ply"
saturation_dn = 3900
[sensor]
longest_exposure_s = {LONGEST}
steps = {STEPS}
bits = 12
gain_e_per_dn = 2.6
read_noise_e = 6.0
dark_e_per_s = 5.0
offset_dn = 64.0
responsivity = [3.1e12]
[rig]
lasers = [{{ wavelength_nm = 635.0 }}]
turntable_angles_deg = {list(ANGLES)}
projector = {{ position_mm = [590.0, 60.0, 110.0], full_angle_deg = 5.0 }}
[[rig.cameras]]
name = "front"
position_mm = [390.0, -120.0, 190.0]
width = {WIDTH}
height = {HEIGHT}
focal_length_mm = 62.0
pixel_pitch_um = 120.0
"""
AIMS = tuple((u, v) for u in (1500, 1800, 2200, 2600) for v in (1600, 1750, 1900))


def body() -> trimesh.Trimesh:
    """About 40 mm, like no mirror image of itself."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=12)
    v = np.array(ball.vertices) * [1.5, 0.9, 0.8]
    v[:, 2] += 0.018 * (v[:, 0] + 4) ** 2 - 3
    v[:, 1] += 0.2 * v[:, 0]
    return trimesh.Trimesh(v, ball.faces, process=False)


@dataclass
class ForeignFrame:
    """A line of the table, and its picture."""

    row: dict[str, object]
    picture: NDArray[np.uint16]


@dataclass
class ForeignCapture:
    """Everything that is written; tests change what they like before that."""

    description: str = DESCRIPTION
    scan: trimesh.Trimesh = field(default_factory=body)
    frames: list[ForeignFrame] = field(default_factory=list)

    def every(self, change: Callable[[NDArray[np.uint16]], NDArray[np.generic]]) -> None:
        """Change all pictures."""
        for frame in self.frames:
            frame.picture = np.asarray(change(frame.picture), np.uint16)

    def rows(self, change: Callable[[dict[str, object]], dict[str, object]]) -> None:
        """Change all lines of the table."""
        for frame in self.frames:
            frame.row |= change(frame.row)

    def write(self, folder: Path) -> Path:
        """Make the folder."""
        (folder / "frames").mkdir(parents=True)
        (folder / "capture.toml").write_text(self.description)
        self.scan.export(folder / "scan.ply")
        for frame in self.frames:
            Image.fromarray(frame.picture).save(folder / str(frame.row["file"]))
        lines = [",".join(COLUMNS), *(",".join(str(f.row[c]) for c in COLUMNS) for f in self.frames)]
        (folder / "images.csv").write_text("\n".join(lines) + "\n")
        return folder


def foreign_capture(exposures: int = 2) -> ForeignCapture:
    """Consistent in every respect; noise as the sensor's."""
    rng, made = np.random.default_rng(1), ForeignCapture()
    rig = RigConfig.model_validate(tomllib.loads(DESCRIPTION)["rig"])
    surface = RayMesh.of(made.scan)

    def add(kind: str, angle: float, u: object, v: object, dn_per_s: NDArray[np.float64]) -> None:
        for k in range(exposures):
            seconds = LONGEST / 2**k
            number = 64 + dn_per_s * seconds + rng.normal(0, 2.3, dn_per_s.shape)
            row = {
                "file": f"frames/{len(made.frames):04d}.png", "kind": kind, "camera": "front", "angle_deg": angle,
                "u": u, "v": v, "laser_nm": "" if kind == "silhouette" else 635, "exposure_s": seconds,
                "power_w": "" if kind == "silhouette" else 0.0101, "time_s": 0.1 * len(made.frames),
            }  # fmt: skip
            made.frames.append(ForeignFrame(row, np.clip(np.rint(number), 0, 4095).astype(np.uint16)))

    for angle in ANGLES:
        turned = turn(np.deg2rad(angle))
        camera = PinholeCamera.from_config(rig.cameras[0]).seen_from(turned)
        add("silhouette", angle, "", "", 120_000.0 * ndimage.gaussian_filter(mesh_mask(made.scan, camera) * 1.0, 0.5))
        projector = TwoMirrorProjector.from_config(rig.projector).seen_from(turned)
        hit = surface.first_hit(*projector.rays(np.array(AIMS, float)))
        for (u, v), triangle, weights in zip(AIMS, hit.triangle, hit.barycentric, strict=True):
            if triangle < 0:
                continue
            x, y = camera.project(surface.points(np.array([triangle]), weights[None]))[0][0]
            row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
            add("spot", angle, u, v, 10.0 ** (6.0 - np.hypot(row - y, column - x) / 6))
    return made
