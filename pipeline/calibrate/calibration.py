"""The calibration file: all that the pipeline has found of a rig, each figure with its uncertainty.

Written from the nominal rig (`nominal_calibration`) or from measurements; only `source` shows which.
Everything is in the object frame (turntable frame at angle 0), mm and radians. A view is a pair of a camera and a
turntable angle, cameras outermost: view = camera * n_angles + angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import trimesh
from pydantic import AfterValidator, Field, model_validator

from hw.base.arrays import F64
from hw.base.config import Strict, as_table, read_json
from hw.base.errors import InputError
from hw.base.files import write_atomically
from hw.interface import Aim
from hw.record import RadianceImage, RawImage, Sensor, to_radiance
from pipeline.geometry.camera import PinholeCamera, Pose, pose_rows, turn
from pipeline.geometry.mesh import displaced
from pipeline.geometry.nominal_rig import RigConfig
from pipeline.geometry.projector import TwoMirrorProjector

NotNegative = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0, le=1e9)]
Error = NotNegative | None  # one standard deviation; None: not measured
Errors3 = tuple[NotNegative, NotNegative, NotNegative] | None  # the same along x, y, z of the device's frame
Errors2 = tuple[NotNegative, NotNegative] | None
Pixels = Annotated[int, Field(ge=1, le=65536)]
Place = Annotated[float, Field(ge=-1e6, le=1e6)]
Factor = Annotated[float, Field(ge=1e-6, le=1e6)]
FullAngle = Annotated[float, Field(gt=0, lt=np.pi)]
WIDEST = 20.0  # image's width over the focal length
ORTHOGONAL = 1e-6  # by which a rotation may miss


def _rigid(pose: Pose) -> Pose:
    matrix = np.array(pose)
    turn = matrix[:3, :3]
    off = float(np.abs(turn @ turn.T - np.eye(3)).max()) if np.abs(turn).max() < 2 else np.inf
    if off > ORTHOGONAL or np.linalg.det(turn) < 0 or (matrix[3] != [0, 0, 0, 1]).any():
        raise ValueError("is no rigid motion: a rotation, a shift in mm, and the last row 0 0 0 1")
    if np.abs(matrix[:3, 3]).max() > 1e6:
        raise ValueError("is a shift of more than a kilometre")
    return pose


RigidPose = Annotated[Pose, AfterValidator(_rigid)]


class ViewCalibration(Strict):
    """One camera at one turntable angle. Lengths in pixels where named so; distortion is k1 k2 p1 p2 k3.

    A pose's errors are those of the object's rotation about its own origin and of that origin, along the camera's axes.
    radiance_factor: per laser, what makes the camera's radiances agree with the photodiode; empty: 1 (not measured)
    """

    camera: str
    angle_rad: float
    width: Pixels
    height: Pixels
    focal_px: tuple[Positive, Positive]
    centre_px: tuple[Place, Place]
    distortion: tuple[float, float, float, float, float]
    object_to_camera: RigidPose
    focal_error_px: Error = None
    centre_error_px: Errors2 = None
    rotation_error_rad: Errors3 = None
    translation_error_mm: Errors3 = None
    radiance_factor: tuple[Factor, ...] = ()
    radiance_factor_error: tuple[NotNegative, ...] = ()

    @model_validator(mode="after")
    def _has_rays(self) -> Self:
        if max(self.width, self.height) > WIDEST * min(self.focal_px):
            raise ValueError(f"focal_px is below a {WIDEST:g}th of the image")
        far = [abs(c - size / 2) > size for c, size in zip(self.centre_px, (self.width, self.height), strict=True)]
        if any(far):
            raise ValueError("centre_px is a whole image away from the image's middle")
        if any(self.distortion):
            focal, centre = np.array(self.focal_px), np.array(self.centre_px)
            distortion = np.array(self.distortion)
            camera = PinholeCamera(self.width, self.height, focal, centre, distortion, np.eye(4))
            x, y = np.linspace(0, self.width, 3), np.linspace(0, self.height, 3)
            with np.errstate(all="ignore"):
                ahead = camera.ahead(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
            if not (np.abs(ahead) <= WIDEST).all():  # nor NaN
                raise ValueError("distortion cannot be undone at the image's corners")
        return self

    @classmethod
    def of(cls, name: str, angle_rad: float, camera: PinholeCamera, **measured: Any) -> Self:
        """A camera in the object frame at a turntable angle; `measured`: the other fields."""
        k1, k2, p1, p2, k3 = (float(x) for x in camera.distortion)
        return cls(
            camera=name, angle_rad=angle_rad, width=camera.width, height=camera.height, focal_px=pair(camera.focal),
            centre_px=pair(camera.centre), distortion=(k1, k2, p1, p2, k3), object_to_camera=pose_rows(camera.pose),
            **measured,
        )  # fmt: skip


class ProjectorCalibration(Strict):
    """The projector at one turntable angle; its pose is relative to the object, which turns."""

    angle_rad: float
    steps: Annotated[int, Field(ge=2, le=65536)]
    full_angle_rad: tuple[FullAngle, FullAngle]
    separation_mm: Annotated[float, Field(ge=0, le=1e4)]
    beam_diameter_mm: Annotated[float, Field(gt=0, le=1e3)]
    object_to_projector: RigidPose
    rotation_error_rad: Errors3 = None
    translation_error_mm: Errors3 = None
    full_angle_error_rad: Errors2 = None

    @classmethod
    def of(cls, angle_rad: float, projector: TwoMirrorProjector, beam_diameter_mm: float, **measured: Any) -> Self:
        """A projector in the object frame at a turntable angle; `measured`: the other fields."""
        return cls(
            angle_rad=angle_rad, steps=projector.steps, full_angle_rad=pair(projector.full_angle_rad),
            separation_mm=projector.separation_mm, beam_diameter_mm=beam_diameter_mm,
            object_to_projector=pose_rows(projector.pose), **measured,
        )  # fmt: skip


class LaserCalibration(Strict):
    """Mean power at the object; the power during one image is the photodiode's reading in the stream."""

    wavelength_nm: Positive
    power_w: Annotated[float, Field(gt=0, le=1e3)]
    power_error_w: Error = None


class ScanCalibration(Strict):
    """By how much the scan is moved along its vertex normals, outward, mm by vertex, and what remains unknown of it."""

    displacement_mm: tuple[Place, ...]
    error_mm: tuple[NotNegative, ...]


class Calibration(Strict):
    """See the module. `vignetting_exponent` n: a pixel seen at angle t off the optical axis receives cos(t)^n.

    scan: None where the scan is used as it came
    """

    format_version: Literal[1] = 1
    source: Literal["nominal", "measured"]
    views: Annotated[tuple[ViewCalibration, ...], Field(min_length=1)]
    projectors: Annotated[tuple[ProjectorCalibration, ...], Field(min_length=1)]  # one per turntable angle
    lasers: Annotated[tuple[LaserCalibration, ...], Field(min_length=1)]
    sensor: Annotated[Sensor, as_table(Sensor)]
    vignetting_exponent: Annotated[float, Field(ge=0, le=8)] = 4.0
    scan: ScanCalibration | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        angles, lasers = len(self.projectors), len(self.lasers)
        if len(self.views) % angles:
            raise ValueError(f"{len(self.views)} views are not as many for each of {angles} angles")
        if len(self.sensor.responsivity) != lasers:
            raise ValueError(f"sensor.responsivity has {len(self.sensor.responsivity)} values for {lasers} lasers")
        if any(len(v.radiance_factor) not in (0, lasers) for v in self.views):
            raise ValueError(f"radiance_factor needs {lasers} values, one a laser, or none")
        if not self.sensor.offset_dn < self.sensor.saturation_dn:
            raise ValueError(f"sensor.offset_dn is not below full scale, {self.sensor.saturation_dn}")
        response = np.array(self.sensor.response)
        if len(response) and (len(response) < 2 or response[0] or response[-1] != 1 or (np.diff(response) <= 0).any()):
            raise ValueError("sensor.response does not rise from 0 to 1")
        return self

    def calibrated(self, scan: trimesh.Trimesh) -> trimesh.Trimesh:
        """The scan with its vertices where the calibration found them, numbered as before.

        Raises: InputError for a scan of another number of vertices.
        """
        if self.scan is None:
            return scan
        if len(self.scan.displacement_mm) != len(scan.vertices):
            raise InputError(
                "the calibration is of another scan", key="scan.displacement_mm", value=len(scan.vertices),
                allowed=f"{len(self.scan.displacement_mm)} vertices", remedy="calibrate again, with this scan",
            )  # fmt: skip
        return displaced(scan, np.array(self.scan.displacement_mm))

    @property
    def n_angles(self) -> int:
        """Number of turntable angles."""
        return len(self.projectors)

    def views_at(self, angle: int) -> range:
        """The views (one per camera) that see the object at turntable angle number `angle`."""
        return range(angle, len(self.views), self.n_angles)

    def view_camera(self, view: int) -> PinholeCamera:
        """The camera of a view in the object frame."""
        v = self.views[view]
        focal, centre = np.array(v.focal_px), np.array(v.centre_px)
        return PinholeCamera(
            v.width, v.height, focal, centre, np.array(v.distortion), np.array(v.object_to_camera, np.float64)
        )

    def projector(self, angle: int) -> TwoMirrorProjector:
        """The projector in the object frame at turntable angle number `angle`."""
        p = self.projectors[angle]
        return TwoMirrorProjector(
            p.steps, np.array(p.full_angle_rad), p.separation_mm, np.array(p.object_to_projector, np.float64)
        )

    def spot_rays(self, aims: Sequence[Aim]) -> tuple[F64, F64]:
        """(S, 3) origins in mm and (S, 3) unit directions of the spots' beam axes in the object frame."""
        origins, directions = np.empty((len(aims), 3)), np.empty((len(aims), 3))
        of_angle = np.array([aim.angle for aim in aims], int)
        steps = np.array([(aim.u, aim.v) for aim in aims], np.float64).reshape(-1, 2)
        for angle in np.unique(of_angle):
            here = of_angle == angle
            origins[here], directions[here] = self.projector(int(angle)).rays(steps[here])
        return origins, directions

    def vignetting(self, view: int) -> F64:
        """(H, W) relative illumination of the pixels by the lens, 1 on the optical axis; read-only."""
        v = self.views[view]
        return _illumination(v.width, v.height, v.focal_px, v.centre_px, v.distortion, self.vignetting_exponent)

    def factor(self, view: int, laser: int) -> float:
        """What makes a camera's radiances of a laser agree with the photodiode (white balance)."""
        factors = self.views[view].radiance_factor
        return factors[laser] if factors else 1.0

    def radiance(self, raw: RawImage, view: int, laser: int) -> RadianceImage:
        """(H, W) radiance in W/(mm^2 sr) with its variance, corrected for vignetting and white balance."""
        image, gain = to_radiance(raw, self.sensor, laser), self.factor(view, laser) / self.vignetting(view)
        return replace(
            image,
            radiance=(image.radiance * gain).astype(np.float32),
            variance=(image.variance * gain**2).astype(np.float32),
        )

    def save(self, path: Path) -> None:
        """Write as JSON; numbers keep all their digits."""
        write_atomically(path, (self.model_dump_json(indent=1) + "\n").encode())

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote. Raises: InputError where it is missing, damaged or of another format version."""
        return read_json(path, cls, "reconstruct again, which calibrates first")


@lru_cache(maxsize=32)
def _illumination(
    width: int,
    height: int,
    focal: tuple[float, float],
    centre: tuple[float, float],
    distortion: tuple[float, ...],
    exponent: float,
) -> F64:
    """(H, W) cos^exponent of the angle off the axis. Kept: the views of a camera share it, and every image needs it."""
    camera = PinholeCamera(width, height, np.array(focal), np.array(centre), np.array(distortion), np.eye(4))
    gain = camera.illumination(exponent)
    gain.flags.writeable = False
    return gain


def pair(values: F64) -> tuple[float, float]:
    """(2,) as the file's tuple."""
    return float(values[0]), float(values[1])


def triple(values: F64) -> tuple[float, float, float]:
    """(3,) as the file's tuple."""
    return float(values[0]), float(values[1]), float(values[2])


def nominal_calibration(rig: RigConfig, sensor: Sensor) -> Calibration:
    """The calibration that would hold if the rig stood exactly as its configuration says."""
    angles = [float(np.deg2rad(a)) for a in rig.turntable_angles_deg]
    cameras = [(config.name, PinholeCamera.from_config(config)) for config in rig.cameras]
    projector, beam = TwoMirrorProjector.from_config(rig.projector), rig.projector.beam_diameter_mm
    return Calibration(
        source="nominal",
        views=tuple(ViewCalibration.of(name, a, c.seen_from(turn(a))) for name, c in cameras for a in angles),
        projectors=tuple(ProjectorCalibration.of(a, projector.seen_from(turn(a)), beam) for a in angles),
        lasers=tuple(LaserCalibration(wavelength_nm=x.wavelength_nm, power_w=x.power_mw * 1e-3) for x in rig.lasers),
        sensor=sensor,
    )
