"""One scene and all that is built from it, each part when it is first asked for."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from disco_twin.experiment.run_folder import content_key
from disco_twin.scene.scene import Scene
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.nominal_rig import CameraConfig

if TYPE_CHECKING:
    import trimesh

    from disco_twin.light.transport import Transport
    from disco_twin.light.truth import Truth
    from disco_twin.object.build import TwinObject
    from pipeline.plan.plan import Plan

SUPERSAMPLE = 4  # rays per pixel and axis that decide which pixels show the object


class Experiment:
    """A scene with its object, scan, plan and light transport. Only `transport` needs the renderer."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    @cached_property
    def object(self) -> TwinObject:
        """The object that light is traced through."""
        from disco_twin.object.build import build_object

        return build_object(self.scene)

    @cached_property
    def scan(self) -> trimesh.Trimesh:
        """The mesh that the pipeline is given."""
        from disco_twin.object.build import build_scan

        return build_scan(self.scene, self.object.mesh)

    @cached_property
    def plan(self) -> Plan:
        """Which images the capture consists of."""
        from pipeline.plan.plan import make_plan

        return make_plan(self.scene.rig, self.scan)

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

    def truth_columns(self) -> NDArray[np.int64]:
        """(n,) scan vertices whose column of R_d is computed, spread evenly over the surface."""
        from pipeline.plan.spots import farthest_points

        points = np.asarray(self.scan.vertices, float)
        return np.sort(farthest_points(points, np.ones(len(points)), self.scene.simulation.truth_columns))

    def truth(self, columns: Sequence[int] | NDArray[np.int64], walks: int) -> Truth:
        """True R_d from these scan vertices to all others, from `walks` photons a column."""
        transport = self.transport
        from disco_twin.light.truth import truth_columns
        from disco_twin.object.mesh import hat_basis

        basis = hat_basis(self.object.mesh, self.scan)
        return truth_columns(transport, basis, np.asarray(columns, np.int64), walks, self.seed("truth"))

    def object_mask(self, view: CameraConfig) -> NDArray[np.bool_]:
        """(H, W) pixels of a held-out view that the object fills by at least a half."""
        from pipeline.geometry.mesh import first_hit

        camera = PinholeCamera.from_config(view)
        face = first_hit(self.object.mesh, *camera.rays(camera.pixel_centres(SUPERSAMPLE))).triangle
        fine = (face >= 0).reshape(camera.height, SUPERSAMPLE, camera.width, SUPERSAMPLE)
        return np.asarray(fine.mean(axis=(1, 3)) >= 0.5)


def identity(scene: Scene) -> str:
    """Key of all that a capture and its ground truth depend on; how they are used may change within a run folder."""
    parts = scene.model_dump(include={"format_version", "name", "seed", "object", "scan", "rig", "simulation"})
    return content_key(plain(parts))


def mm_per_pixel(camera: CameraConfig) -> float:
    """Size of a pixel at the distance of the point that the camera aims at."""
    distance = float(np.linalg.norm(np.subtract(camera.position_mm, camera.aim_mm)))
    return distance * camera.pixel_pitch_um * 1e-3 / camera.focal_length_mm


def plain(value: Any) -> Any:
    """JSON's types; a file becomes the key of its content."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, Path):
        return content_key(value)
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(v) for v in value]
    return value


def left_out_by_the_twin(experiment: Experiment) -> list[dict[str, str]]:
    """What the simulation does without for this scene, and why; decided from the scene alone."""
    scene, medium = experiment.scene, experiment.object.medium
    out = []
    if all(np.ptp(m) == 0 for a in (medium.sigma_t, medium.albedo) for m in a):
        out.append(("medium grid", "the medium is homogeneous"))
    same = all(np.array_equal(s, medium.sigma_t[0]) for s in medium.sigma_t) and len(set(medium.g)) == 1
    if len(medium.sigma_t) > 1 and same:
        out.append(("a walk per wavelength", "sigma_t and g are the same at all wavelengths: one walk serves them"))
    if experiment.object.boundary.kind == "matched":
        out.append(("boundary sampling", "the object is index-matched"))
    if all(g == 0 for g in medium.g):
        out.append(("phase function sampling", "scattering is isotropic (g = 0)"))
    faults = [name for name, on in scene.rig.faults.model_dump().items() if not on]
    if faults:
        out.append((f"rig faults: {', '.join(faults)}", "the scene switches them off"))
    return [{"what": what, "because": because} for what, because in out]
