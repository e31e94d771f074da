"""One scene and all that is built from it, each part when it is first asked for."""

from __future__ import annotations

import zlib
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from disco_twin.object.build import TwinObject, build_object, build_scan
from hw.base.arrays import Bool
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.plan.plan import Plan, make_plan
from pipeline.plan.visibility import warn_of_frame

if TYPE_CHECKING:
    from disco_twin.light.transport import Transport
    from disco_twin.scene.scene import Scene  # its settings of the reconstruction are no part of what is simulated

SUPERSAMPLE = 4  # rays per pixel and axis that decide which pixels show the object


class Experiment:
    """A scene with its object, scan, plan and light transport. Only `transport` needs the renderer."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    @cached_property
    def object(self) -> TwinObject:
        """The object that light is traced through."""
        return build_object(self.scene)

    @cached_property
    def scan(self) -> trimesh.Trimesh:
        """The mesh that the pipeline is given."""
        return build_scan(self.scene, self.object.mesh)

    @cached_property
    def plan(self) -> Plan:
        """Which images the capture consists of."""
        return make_plan(self.scene.rig, self.scan)

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """What is no error, but should be known before the capture: cameras that do not see the whole object."""
        rig = self.scene.rig
        angles = [float(angle) for angle in np.deg2rad(rig.turntable_angles_deg)]
        lines = [
            warn_of_frame(camera, self.scan, f"rig.cameras[{i}]", f"the camera {camera.name!r}", angles)
            for i, camera in enumerate(rig.cameras)
        ] + [
            warn_of_frame(view, self.scan, f"relight.views[{i}]", f"the held-out view {view.name!r}")
            for i, view in enumerate(self.scene.relight.views)
        ]
        return tuple(line for line in lines if line is not None)

    @cached_property
    def transport(self) -> Transport:
        """The photon walk through the object; starts the renderer."""
        from disco_twin.light.backend import activate

        activate()
        from disco_twin.light.transport import Transport

        return Transport(self.object)

    def seed(self, purpose: str) -> int:
        """A seed of its own for every purpose, from the scene's root seed."""
        tree = np.random.SeedSequence([self.scene.seed, zlib.crc32(purpose.encode())])
        return int(tree.generate_state(1)[0])

    def object_mask(self, view: CameraConfig) -> Bool:
        """(H, W) pixels of a held-out view that the object fills by at least a half."""
        camera = PinholeCamera.from_config(view)
        face = RayMesh.of(self.object.mesh).first_hit(*camera.rays(camera.pixel_centres(SUPERSAMPLE))).triangle
        fine = (face >= 0).reshape(camera.height, SUPERSAMPLE, camera.width, SUPERSAMPLE)
        return np.asarray(fine.mean(axis=(1, 3)) >= 0.5)


def mm_per_pixel(camera: CameraConfig) -> float:
    """Size of a pixel at the distance of the point that the camera aims at."""
    distance = float(np.linalg.norm(np.subtract(camera.position_mm, camera.aim_mm)))
    return distance * camera.pixel_pitch_um * 1e-3 / camera.focal_length_mm
