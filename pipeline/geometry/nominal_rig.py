"""What a rig is, nominally: lasers, projector, cameras, turntable, sweep. The schema of CAPTURE/rig.json.

The pipeline is given this nominal rig and nothing else; the actual rig, a real one or the twin's, departs from it.
Lengths in mm, angles in degrees here and radians everywhere else.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from hw.base.config import Strict
from pipeline.geometry.distortion import covers_image

Length = Annotated[float, Field(ge=-1e6, le=1e6)]
Point = tuple[Length, Length, Length]
Positive = Annotated[float, Field(gt=0, le=1e9)]
Angle = Annotated[float, Field(ge=-360, le=360)]


class LaserConfig(Strict):
    """One laser of the fibre (thesis 4.2: 635, 532 and 476 nm at about 10 mW)."""

    wavelength_nm: Annotated[float, Field(ge=300, le=1100)]
    power_mw: Annotated[float, Field(gt=0, le=500)] = 10.0


class Aimed(Strict):
    """A device at a place, turned towards another; `up` is up in its image (see `pipeline.geometry.camera.look_at`)."""

    position_mm: Point
    aim_mm: Point = (0.0, 0.0, 0.0)
    up: Point = (0.0, 0.0, 1.0)

    @model_validator(mode="after")
    def _looks_somewhere(self) -> Self:
        if math.hypot(*self.up) < 1e-9:
            raise ValueError("up is the zero vector: give a direction, such as [0.0, 0.0, 1.0]")
        if self.position_mm == self.aim_mm:
            raise ValueError("position_mm equals aim_mm: aim at another point than the device's own place")
        return self


class ProjectorConfig(Aimed):
    """The two-mirror projector. `separation_mm` is the distance between the mirrors (0: a pinhole)."""

    position_mm: Point = (600.0, 0.0, 120.0)
    full_angle_deg: Annotated[float, Field(gt=0, le=90)] = 12.0
    steps: Annotated[int, Field(ge=2, le=65536)] = 4096
    separation_mm: Annotated[float, Field(ge=0, le=100)] = 12.0
    beam_diameter_mm: Annotated[float, Field(gt=0, le=50)] = 2.0
    beam_profile: Literal["gaussian", "uniform"] = "uniform"


class CameraConfig(Aimed):
    """A camera. The principal point is the image centre; distortion is OpenCV's k1 k2 p1 p2 k3."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_-]+$", max_length=32)]
    width: Annotated[int, Field(ge=16, le=8192)] = 768
    height: Annotated[int, Field(ge=16, le=8192)] = 496
    focal_length_mm: Positive = 25.0
    pixel_pitch_um: Positive = 11.0
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _undistortable(self) -> Self:
        pixel = self.pixel_pitch_um * 1e-3 / self.focal_length_mm
        if not covers_image(self.distortion, self.width / 2 * pixel, self.height / 2 * pixel):
            raise ValueError(
                f"distortion = {list(self.distortion)} cannot be undone: before the image's edge the picture folds "
                "over. Give k1 k2 p1 p2 k3 with r (1 + k1 r^2 + k2 r^4 + k3 r^6) rising over the image"
            )
        return self


class SensorConfig(Strict):
    """The Lars III as far as it is published (thesis 4.3); the rest are the figures of comparable CMOS sensors."""

    longest_exposure_s: Annotated[float, Field(gt=0, le=10)] = 1.0 / 30.0
    steps: Annotated[int, Field(ge=1, le=24)] = 12
    bits: Annotated[int, Field(ge=6, le=16)] = 12
    full_well_e: Annotated[float, Field(ge=1e3, le=1e7)] = 100_000.0
    read_noise_e: Annotated[float, Field(ge=0, le=1e3)] = 25.0
    dark_e_per_s: Annotated[float, Field(ge=0, le=1e6)] = 500.0
    offset_dn: Annotated[float, Field(ge=0, le=1024)] = 64.0
    response: Literal["linear", "curved"] = "linear"  # curved: what a digital number stands for has to be calibrated


class RigConfig(Strict):
    """The nominal rig. Views are all pairs of a camera and a turntable angle, cameras outermost (thesis fig. 4.1)."""

    lasers: Annotated[tuple[LaserConfig, ...], Field(min_length=1, max_length=3)] = (
        LaserConfig(wavelength_nm=635),
        LaserConfig(wavelength_nm=532),
        LaserConfig(wavelength_nm=476),
    )
    projector: ProjectorConfig = ProjectorConfig()
    cameras: Annotated[tuple[CameraConfig, ...], Field(min_length=1, max_length=32)]
    sensor: SensorConfig = SensorConfig()
    turntable_angles_deg: Annotated[tuple[Angle, ...], Field(min_length=1, max_length=72)] = (0.0,)
    spots: Annotated[int, Field(ge=1, le=200_000)] = 300  # over all turntable angles
    max_incidence_deg: Annotated[float, Field(gt=0, le=89)] = 60.0

    @model_validator(mode="after")
    def _distinct(self) -> RigConfig:
        names = [c.name for c in self.cameras]
        if len(set(names)) < len(names):
            raise ValueError("camera names must be distinct")
        if len({a % 360 for a in self.turntable_angles_deg}) < len(self.turntable_angles_deg):
            raise ValueError("turntable angles must be distinct")
        return self
