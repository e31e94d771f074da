"""One scene and all that is built from it, each part when it is first asked for."""

from __future__ import annotations

import zlib
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from disco_twin.experiment.object_pixels import ObjectPixels
from disco_twin.object.build import TwinObject, build_object, build_scan, rounding
from hw.base.arrays import Bool
from hw.base.errors import InputError
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.plan.plan import Plan, make_plan
from pipeline.plan.visibility import warn_of_frame

if TYPE_CHECKING:
    from disco_twin.light.transport import Transport
    from disco_twin.scene.scene import Scene  # its settings of the reconstruction are no part of what is simulated


ROUGH = 0.005  # of a free path: rounding of places that shows


class Experiment:
    """A scene with its object, scan, plan and light transport. Only `transport` needs the renderer."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._pixels: dict[str, ObjectPixels] = {}

    @cached_property
    def object(self) -> TwinObject:
        """The object that light is traced through. Raises: InputError as `build_object`."""
        return build_object(self.scene)

    @cached_property
    def scan(self) -> trimesh.Trimesh:
        """The mesh that the pipeline is given. Raises: InputError as `build_scan`."""
        return build_scan(self.scene, self.object.mesh)

    @cached_property
    def plan(self) -> Plan:
        """Which images the capture consists of. Raises: InputError as `make_plan`."""
        return make_plan(self.scene.rig, self.scan)

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """What is no error, but should be known before the capture: cameras that do not see the whole object, media too
        dense for single precision.
        """
        rig = self.scene.rig
        angles = [float(angle) for angle in np.deg2rad(rig.turntable_angles_deg)]
        lines = [
            warn_of_frame(camera, self.scan, f"rig.cameras[{i}]", f"the camera {camera.name!r}", angles)
            for i, camera in enumerate(rig.cameras)
        ] + [
            warn_of_frame(view, self.scan, f"relight.views[{i}]", f"the held-out view {view.name!r}")
            for i, view in enumerate(self.scene.relight.views)
        ]
        return tuple(line for line in (*lines, rounding_warning(self.object)) if line is not None)

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

    def object_pixels(self, view: CameraConfig) -> ObjectPixels:
        """The pixels of a held-out view that show the object."""
        key = view.model_dump_json()
        if key not in self._pixels:
            self._pixels[key] = ObjectPixels.of(self.object.mesh, PinholeCamera.from_config(view))
        return self._pixels[key]

    @cached_property
    def beyond_neck(self) -> Bool | None:
        """(V,) the scan's vertices on that side of the neck to which its normal points; None where the scene has none.

        Raises: InputError where the plane does not cut the scan.
        """
        neck = self.scene.relight.neck
        if neck is None:
            return None
        beyond = (np.asarray(self.scan.vertices) - neck.through_mm) @ np.array(neck.normal) > 0
        if beyond.all() or not beyond.any():
            low, high = self.scan.bounds
            raise InputError(
                "the neck's plane does not cut the object", key="relight.neck.through_mm", value=neck.through_mm,
                allowed=f"inside {low.round(1).tolist()} .. {high.round(1).tolist()}", remedy="move or turn the plane",
            )  # fmt: skip
        return np.asarray(beyond)


def rounding_warning(obj: TwinObject) -> str | None:
    """A line where free paths are so short that single precision shows; None elsewhere (docs/decisions/0133)."""
    share, reach, sigma_t = rounding(obj)
    if share < ROUGH:
        return None
    problem = (
        f"free paths of {1 / sigma_t:.1g} mm are but {1 / share:.0f} steps of single precision {reach:.0f} mm from"
    )
    effect = f"what leaves the object is off by up to about {100 * share:.1g} %"
    return f"{problem} the origin: {effect}. Remedy: a smaller object around the origin, or a lower sigma_t"


def mm_per_pixel(camera: CameraConfig) -> float:
    """Size of a pixel at the distance of the point that the camera aims at."""
    distance = float(np.linalg.norm(np.subtract(camera.position_mm, camera.aim_mm)))
    return distance * camera.pixel_pitch_um * 1e-3 / camera.focal_length_mm
