"""An object of ours as a stock Mitsuba scene for `volpath`, the outside renderer of tests and benchmarks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from disco_twin.object.build import TwinObject
from pipeline.geometry.camera import PinholeCamera
from pipeline.relight.lights import Directional, Uniform

DEPTH = 4000  # Russian roulette starts here, that is, never: volpath caps survival at .95 even on null collisions


def volpath_scene(
    obj: TwinObject, camera: PinholeCamera, light: Directional | Uniform | dict[str, Any], folder: Path
) -> Any:
    """The object (laser 0), one undistorted camera and one emitter (or Mitsuba's own description of one); the mesh is
    written to `folder`.
    """
    path = folder / "object.ply"
    obj.mesh.export(path, vertex_normal=False)
    emitter: dict[str, Any]
    medium, eta = obj.medium, obj.boundary.eta
    to_world = mi.ScalarTransform4f().translate(list(medium.low)).scale(list(medium.high - medium.low))

    def volume(values: NDArray[np.float32]) -> dict[str, Any]:
        grid = mi.VolumeGrid(np.ascontiguousarray(values[..., None], np.float32))
        look_up = {"filter_type": "trilinear", "wrap_mode": "clamp"}
        return {"type": "gridvolume", "grid": grid, "to_world": to_world, **look_up}

    rough = {
        "type": "roughdielectric", "int_ior": eta, "ext_ior": 1.0, "alpha": obj.boundary.alpha, "distribution": "ggx",
    }  # fmt: skip
    if isinstance(light, Uniform):
        emitter = {"type": "constant", "radiance": light.radiance}
    elif isinstance(light, Directional):
        emitter = {"type": "directional", "direction": list(light.direction), "irradiance": light.irradiance}
    else:
        emitter = light
    position = camera.position
    view = mi.ScalarTransform4f().look_at(
        origin=list(position), target=list(position + camera.pose[2, :3]), up=list(-camera.pose[1, :3])
    )
    return mi.load_dict(
        {
            "type": "scene",
            "emitter": emitter,
            "object": {
                "type": "ply",
                "filename": str(path),
                "face_normals": True,
                "bsdf": {"type": "null"} if obj.boundary.kind == "matched" else rough,
                "interior": {
                    "type": "heterogeneous",
                    "sigma_t": volume(medium.sigma_t[0]),
                    "albedo": volume(medium.albedo[0]),
                    "has_spectral_extinction": False,
                    "phase": {"type": "hg", "g": medium.g[0]},
                },
            },
            "sensor": {
                "type": "perspective",
                "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / camera.focal[0]))),
                "fov_axis": "x",
                "to_world": view,
                "film": {
                    "type": "hdrfilm", "width": camera.width, "height": camera.height, "pixel_format": "luminance",
                    "rfilter": {"type": "box"}, "component_format": "float32",
                },
                "sampler": {"type": "independent"},
            },
            "integrator": {"type": "volpath", "max_depth": DEPTH, "rr_depth": DEPTH, "hide_emitters": True},
        }
    )  # fmt: skip
