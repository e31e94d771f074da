"""A capture of a sphere with a known R_d, written without a renderer: radiance straight from eq. 2.1."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from hw.record import RawImage, Sensor
from pipeline.calibrate.calibration import Calibration, nominal_calibration
from pipeline.geometry.fresnel import Boundary, transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.nominal_rig import CameraConfig, LaserConfig, ProjectorConfig, RigConfig, SensorConfig
from pipeline.plan.plan import ImageAddress, Plan, make_plan
from pipeline.records import NominalRigFile, SensorFile
from pipeline.stream.stream import ImageMeta, StreamWriter

RADIUS = 15.0
ETA = 1.3
SENSOR = Sensor(1 / 30, 12, 12, 24.8, 25.0, 500.0, 64.0, (2e14, 2e14), 43_750.0)
POWER = (0.01, 0.008)


def reflectance(distance: np.ndarray, laser: int) -> np.ndarray:
    """R_d in mm^-2: wide enough that averaging over hats and beam changes it little."""
    return np.asarray((0.004 - 0.001 * laser) * np.exp(-distance / 6.0))


def pattern(points: np.ndarray) -> np.ndarray:
    """(N,) factor of R_d at either end; tests put one in its place."""
    return np.ones(len(points))


def rig() -> RigConfig:
    """Two cameras, two turntable angles, two lasers."""
    common = {"width": 96, "height": 80, "focal_length_mm": 20.0, "pixel_pitch_um": 20.0}
    front = CameraConfig(name="front", position_mm=(380.0, -140.0, 120.0), **common)
    back = CameraConfig(name="back", position_mm=(-350.0, 160.0, -100.0), **common)
    return RigConfig(
        lasers=(LaserConfig(wavelength_nm=635), LaserConfig(wavelength_nm=532, power_mw=8.0)),
        projector=ProjectorConfig(full_angle_deg=5.0),
        cameras=(front, back),
        sensor=SensorConfig(),
        turntable_angles_deg=(0.0, 150.0),
        spots=24,
    )


def expose(radiance: np.ndarray, laser: int) -> RawImage:
    """A noiseless sensor that digitises finely: the longest exposure that does not saturate."""
    rate = radiance * SENSOR.responsivity[laser] + SENSOR.dark_e_per_s
    full = 0.9 * SENSOR.saturation_dn * SENSOR.gain_e_per_dn
    need = np.ceil(np.log2(np.maximum(rate * SENSOR.longest_exposure_s / full, 1e-9)))
    exponent = np.clip(need, 0, SENSOR.steps - 1).astype(np.uint8)
    electrons = rate * SENSOR.longest_exposure_s * 2.0 ** -exponent.astype(float)
    charge = np.clip(np.rint(electrons / SENSOR.gain_e_per_dn + SENSOR.offset_dn), 0, SENSOR.saturation_dn)
    return RawImage(exponent, charge.astype(np.uint16))


def images(calibration: Calibration, plan: Plan, address: ImageAddress, boundary: float | Boundary = ETA) -> np.ndarray:
    """(H, W) radiance of the sphere at pixel centres, before the lens."""
    camera = calibration.view_camera(address.view)
    origins, directions = camera.rays(camera.pixel_centres())
    b = (origins * directions).sum(axis=1)
    root = b**2 - (origins**2).sum(axis=1) + RADIUS**2
    hit = root > 0
    points = origins + directions * (-b - np.sqrt(np.maximum(root, 0)))[:, None]
    normal = points / RADIUS
    if address.kind == "silhouette":
        return np.where(hit, 1e-6, 0.0).reshape(camera.height, camera.width)
    o, d = (x[0] for x in calibration.spot_rays([plan.spots[address.spot]]))
    at = o + d * (-(o @ d) - np.sqrt((o @ d) ** 2 - o @ o + RADIUS**2))
    entering = transmittance(-(at / RADIUS) @ d, boundary) * POWER[address.laser]
    leaving = transmittance(-(normal * directions).sum(axis=1), boundary)
    r = reflectance(np.linalg.norm(points - at, axis=1), address.laser) * pattern(points) * pattern(at[None])
    out = np.where(hit, leaving / np.pi * r * entering, 0.0)
    return np.asarray(out.reshape(camera.height, camera.width))


def write_capture(
    folder: Path, subdivisions: int = 2, scan: trimesh.Trimesh | None = None, boundary: float | Boundary = ETA
) -> trimesh.Trimesh:
    """Everything that the pipeline reads, of a sphere with this boundary; returns the scan."""
    folder.mkdir(parents=True)
    mesh = scan or trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
    config = rig()
    calibration = nominal_calibration(config, SENSOR)
    plan = make_plan(config, mesh)
    with StreamWriter(folder, plan) as stream:
        for n, address in enumerate(plan.addresses()):
            aim = plan.spots[address.spot] if address.spot >= 0 else None
            lens = calibration.vignetting(address.view)
            raw = expose(images(calibration, plan, address, boundary) * lens, max(address.laser, 0))
            power = POWER[address.laser] if aim else 0.0
            angle = plan.angles_rad[plan.angle_of(address.view)]
            meta = ImageMeta(n / 15, power, angle, aim.u if aim else -1, aim.v if aim else -1)
            stream.append(address, raw, meta)
    mesh.export(folder / "scan.ply")
    (folder / "rig.json").write_text(NominalRigFile(format_version=1, rig=config).model_dump_json())
    (folder / "sensor.json").write_text(SensorFile(format_version=1, sensor=SENSOR).model_dump_json())
    assert (RayMesh.of(mesh).first_hit(*calibration.spot_rays(plan.spots)).triangle >= 0).all()
    return mesh
