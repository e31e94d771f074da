"""Images for the tests of the calibration: an irregular object and boards before seeded rigs, without the renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.ray.ray_pyembree import RayMeshIntersector

from disco_twin.camera.lars3 import Lars3, lars3_sensor
from disco_twin.camera.targets import TargetSource
from disco_twin.emulation.twin_rig import BracketRig, TargetRig, TwinRig
from disco_twin.experiment.experiment import Experiment
from disco_twin.faults.actual_rig import ActualRig, actual_rig
from disco_twin.faults.light_faults import Stream, generator
from disco_twin.object.scanner import ERROR_MM, geometry_error
from disco_twin.scene.rig_schema import TwinRigConfig
from disco_twin.scene.scene import load_scene
from hw.interface import Aim
from hw.record import to_radiance
from pipeline.capture.loop import capture
from pipeline.geometry.camera import PinholeCamera
from pipeline.plan.plan import make_plan
from pipeline.plan.targets import BRACKET, FOLDER, TARGETS, Targets, make_bracket, make_targets

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
QUICK = Path(__file__).parents[2] / "scenes" / "quick.toml"


@cache
def experiment() -> Experiment:
    """The quick scene, before an ideal rig."""
    return Experiment(load_scene(QUICK, faults=False))


def faulty_rig(width: int = 192, angles: tuple[float, ...] = (0.0, 120.0, 240.0)) -> TwinRigConfig:
    """The quick scene's rig with deviation and flare; 768 gives the Lars III's own resolution."""
    rig = experiment().scene.rig
    faults = rig.faults.model_copy(update={"deviation": True, "flare": True})
    cameras = tuple(
        c.model_copy(update={"width": width, "height": width * 124 // 192, "pixel_pitch_um": 44.0 * 192 / width})
        for c in rig.cameras
    )
    return rig.model_copy(update={"faults": faults, "cameras": cameras, "turntable_angles_deg": angles})


def photograph(rig: TwinRigConfig, camera: PinholeCamera, radiance: F32, seed: int) -> F32:
    """(H, W) radiance through the twin's lens and sensor, as the pipeline reads it."""
    raw = Lars3.of(rig, camera).expose(radiance, 0, generator(seed, Stream.SENSOR, 99))
    return to_radiance(raw, lars3_sensor(rig), 0).radiance


def floodlit(mesh: trimesh.Trimesh, camera: PinholeCamera, supersample: int = 4) -> F32:
    """(H, W) what `disco_twin.light.response.floodlit` shows, without the renderer."""
    s = supersample
    origins, directions = camera.rays(camera.pixel_centres(s))
    triangle = RayMeshIntersector(mesh).intersects_first(origins, directions)
    cosine = np.abs((mesh.face_normals[np.maximum(triangle, 0)] * directions).sum(axis=1))
    shade = np.where(triangle >= 0, 0.3 + 0.7 * cosine, 0.0) * 2e-5
    return np.asarray(shade.reshape(camera.height, s, camera.width, s).mean(axis=(1, 3)), np.float32)


@dataclass(frozen=True)
class Silhouettes:
    """images and truth: per view; lenses: per camera the actual lens at the nominal place."""

    images: list[F32]
    truth: list[PinholeCamera]
    lenses: list[PinholeCamera]
    angles: list[float]
    actual: ActualRig


def silhouettes(seed: int, mesh: trimesh.Trimesh, rig: TwinRigConfig | None = None) -> Silhouettes:
    """Every view of a seeded rig."""
    rig = rig or faulty_rig()
    actual = actual_rig(rig, seed)
    views = [actual.camera(c, j) for c in range(len(rig.cameras)) for j in range(len(rig.turntable_angles_deg))]
    images = [photograph(rig, view, floodlit(mesh, view), 1000 * seed + k) for k, view in enumerate(views)]
    lenses = []
    for config, real in zip(rig.cameras, actual.cameras, strict=True):
        nominal = PinholeCamera.from_config(config)
        lenses.append(replace(nominal, focal=real.focal, centre=real.centre, distortion=real.distortion))
    return Silhouettes(images, views, lenses, [float(a) for a in np.deg2rad(rig.turntable_angles_deg)], actual)


def boards(seed: int, rig: TwinRigConfig, camera: int) -> tuple[Targets, list[F32], PinholeCamera]:
    """Photographs of all boards by one camera of a seeded rig, and the camera as it is; taken once."""
    return _boards(seed, rig.model_dump_json(), camera)


@cache
def _boards(seed: int, rig_json: str, camera: int) -> tuple[Targets, list[F32], PinholeCamera]:
    rig = TwinRigConfig.model_validate_json(rig_json)
    actual = actual_rig(rig, seed)
    targets, _ = make_targets(rig, camera)
    source = TargetSource(targets, actual.cameras[camera], actual, rig.projector.beam_diameter_mm / 2)
    images = [
        photograph(rig, actual.cameras[camera], source.silhouette(camera, i), 1000 * seed + i)
        for i, p in enumerate(targets.placements)
        if p.kind == "board"
    ]
    return targets, images, actual.cameras[camera]


SHIFT = (0.24, 0.18)  # mm per sine of the angle to the normal, and per its cube
WANDER, PATCH = 0.045, 0.016  # mm per axis


def shifted(tangent: F64) -> F64:
    """(..., 3) mm by which a peak moves along a direction's tangential part."""
    return np.asarray((SHIFT[0] + SHIFT[1] * (tangent**2).sum(axis=-1, keepdims=True)) * tangent)


class Glowing:
    """A `ResponseSource` without transport: a matt surface with the beam's footprint and a glow that fades around it.

    Peaks move as the quick scene's do under the twin's own transport (286 spots of a run with all faults, against the
    true mesh and the true beams): by SHIFT along the light's way and towards the eye, by WANDER from spot to spot, and
    by PATCH alike within 10 mm.
    """

    def __init__(self, rig: TwinRigConfig, actual: ActualRig, mesh: trimesh.Trimesh) -> None:
        self.rig, self.actual, self.mesh = rig, actual, mesh
        self.ray = RayMeshIntersector(mesh)
        self._seen: dict[tuple[int, int], tuple[F64, F64, NDArray[np.bool_]]] = {}
        self._last: tuple[tuple[int, Aim], F32] | None = None

    def prepare(self, aims: Sequence[Aim]) -> None:
        """Nothing to do."""

    def silhouette(self, camera: int, angle: int) -> F32:
        return floodlit(self.mesh, self.actual.camera(camera, angle))

    def _surface(self, camera: int, angle: int) -> tuple[F64, F64, NDArray[np.bool_]]:
        if (camera, angle) not in self._seen:
            lens = self.actual.camera(camera, angle)
            origin, way = lens.rays(lens.pixel_centres(2))
            face = self.ray.intersects_first(origin, way)
            hit = face >= 0
            corner, normal = self.mesh.triangles[face, 0], self.mesh.face_normals[face]
            along = ((corner - origin) * normal).sum(axis=1) / (way * normal).sum(axis=1)
            tangent = -way - (-way * normal).sum(axis=1, keepdims=True) * normal
            place = origin + along[:, None] * way - shifted(tangent)  # light seen here left from there
            self._seen[camera, angle] = place, normal, hit
        return self._seen[camera, angle]

    def image(self, camera: int, aim: Aim, laser: int) -> F32:
        if self._last is None or self._last[0] != (camera, aim):  # the same for all lasers
            self._last = (camera, aim), self._image(camera, aim)
        return self._last[1]

    def _image(self, camera: int, aim: Aim) -> F32:
        place, normal, hit = self._surface(camera, aim.angle)
        origin, way = (x[0] for x in self.actual.spot_rays([aim]))
        lens, radius = self.actual.camera(camera, aim.angle), self.rig.projector.beam_diameter_mm / 2
        spot, _, face = self.ray.intersects_location(origin[None], way[None], multiple_hits=False)
        if not len(face):
            return np.zeros((lens.height, lens.width), np.float32)
        facing = self.mesh.face_normals[face[0]]
        wander = WANDER * generator(self.actual.seed, Stream.SPECKLE, 77, aim.angle, aim.u, aim.v).standard_normal(3)
        fields = generator(self.actual.seed, Stream.SCANNER, 77)
        wander += [PATCH / ERROR_MM * geometry_error(spot, fields)[0] for _ in range(3)]
        entry = place - shifted(way - (way @ facing) * facing) - (wander - (wander @ facing) * facing)
        away = entry - spot[0]
        across = (away**2).sum(axis=1) - (away @ way) ** 2
        lit = (across < radius**2) & (normal @ way < 0) & ((away**2).sum(axis=1) < (4 * radius) ** 2)
        glow = np.exp(-np.linalg.norm(away, axis=1) / 3.0) / (2 * np.pi * 9.0)
        light = np.where(hit, 0.25 * lit * -(normal @ way) / (np.pi * radius**2) + 0.4 * glow, 0.0) / np.pi
        fine = light.reshape(lens.height, 2, lens.width, 2)
        return np.asarray(fine.mean(axis=(1, 3)), np.float32)


def flickering_rig() -> TwinRigConfig:
    """`faulty_rig` with all faults of the light."""
    rig = faulty_rig()
    on = dict.fromkeys(("warm_up", "blue_noise", "mode_hop", "speckle"), True)
    return rig.model_copy(update={"faults": rig.faults.model_copy(update=on)})


def capture_targets(folder: Path, rig: TwinRigConfig, seed: int, camera: int) -> tuple[Targets, TargetSource]:
    """A camera's boards and white plate before a seeded rig; the source knows where they really stood."""
    actual = actual_rig(rig, seed)
    targets, plan = make_targets(rig, camera)
    source = TargetSource(targets, actual.cameras[camera], actual, rig.projector.beam_diameter_mm / 2)
    capture(TargetRig(rig, source, seed, actual, camera, len(targets.placements)), plan, folder)
    (folder / TARGETS).write_text(targets.model_dump_json())
    return targets, source


def capture_all(
    folder: Path, seed: int, spots: int = 90, mesh: trimesh.Trimesh | None = None, curved: bool = False
) -> TwinRigConfig:
    """A whole capture of the quick scene's object by a seeded rig, calibration images included; the nominal rig."""
    rig = flickering_rig().model_copy(update={"spots": spots})
    if curved:
        rig = rig.model_copy(update={"sensor": rig.sensor.model_copy(update={"response": "curved"})})
    actual = actual_rig(rig, seed)
    for c, lens in enumerate(actual.cameras):
        own = folder / FOLDER / rig.cameras[c].name
        capture_targets(own, rig, seed, c)
        if curved:
            still, exposures = make_bracket(rig, c)
            source = TargetSource(still, lens, actual, rig.projector.beam_diameter_mm / 2)
            capture(BracketRig(rig, source, seed, actual, c, len(still.placements)), exposures, own / BRACKET)
    source = Glowing(rig, actual, mesh or experiment().object.mesh)
    capture(TwinRig(rig, source, seed, actual), make_plan(rig, experiment().scan), folder)
    return rig
