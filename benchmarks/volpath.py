"""An object of ours as a stock Mitsuba scene for `volpath`, the outside renderer of tests, benchmarks and references.

Works in Mitsuba's monochrome variant (laser 0) and in an rgb one (three lasers of one sigma_t and g in one render:
channels are lasers, no colour is converted).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from disco_twin.object.build import Medium, TwinObject
from hw.base.arrays import F32, F64
from hw.base.errors import InputError
from pipeline.geometry.camera import PinholeCamera
from pipeline.relight.lights import Colour, Directional, Environment, Uniform

DEPTH = 4000  # Russian roulette starts here, that is, never: volpath caps survival at .95 even on null collisions
FINER = 5  # voxels of a varying albedo are parted into so many an axis, see `tables`
LOBE_ERROR = 1e-4  # of a lobe's peak, by linear interpolation between the environment map's pixels, both axes together
BACK_MM = 1000.0  # distance of the emitter that nothing sees, see `volpath_scene`

Window = tuple[int, int, int, int]  # of a picture: left, top, width, height in pixels


def volpath_scene(
    obj: TwinObject,
    camera: PinholeCamera,
    light: Directional | Uniform | Environment | dict[str, Any],
    folder: Path,
    window: Window | None = None,
    connect: bool = True,
) -> Any:
    """The object, one camera and one light (or Mitsuba's own description of one); the mesh is written to `folder`.

    window: the part of the picture that is rendered, all of it if left out. connect=False: no shadow rays, the light is
    met where paths leave. A rough boundary blocks every one of them, and they take half of the time; it is for lights
    that are not a point, a line or a direction.

    Raises: InputError for a camera that distorts, for bodies inside and for lasers that cannot share paths.
    """
    if obj.inside:
        raise InputError("outside renders know no bodies inside the object", allowed="objects without `inside`")
    if camera.distortion.any():
        raise InputError("Mitsuba's own camera has no distortion", value=camera.distortion.tolist(), allowed="zeros")
    path = folder / "object.ply"
    obj.mesh.export(path, vertex_normal=False)
    eta = obj.boundary.eta
    rough = {
        "type": "roughdielectric", "int_ior": eta, "ext_ior": 1.0, "alpha": obj.boundary.alpha, "distribution": "ggx",
    }  # fmt: skip
    parts = {"emitter": emitter(light)}
    if not connect:
        # One emitter has to be there for volpath to sample: this one shows its back, which it finds without a ray.
        parts["emitter"] |= {"sampling_weight": 0.0}
        behind = mi.ScalarTransform4f().translate([0, 0, BACK_MM]).scale(1e-3)
        parts["back"] = {"type": "rectangle", "to_world": behind, "emitter": {"type": "area", "radiance": 1.0}}
    return mi.load_dict(
        {
            "type": "scene",
            **parts,
            "object": {
                "type": "ply",
                "filename": str(path),
                "face_normals": True,
                "bsdf": {"type": "null"} if obj.boundary.kind == "matched" else rough,
                "interior": interior(obj.medium),
            },
            "sensor": sensor(camera, window),
            "integrator": {"type": "volpath", "max_depth": DEPTH, "rr_depth": DEPTH, "hide_emitters": True},
        }
    )


def lasers_in_one() -> int:
    """How many lasers one render serves in Mitsuba's variant of today."""
    return 3 if "rgb" in mi.variant() else 1


def interior(medium: Medium) -> dict[str, Any]:
    """Mitsuba's description of what fills the object.

    Raises: InputError where the lasers of one render do not have one sigma_t and one g, or where g varies.
    """
    if medium.g_voxels is not None:
        raise InputError("one phase function serves the whole of Mitsuba's medium", allowed="one g for all voxels")
    lasers = lasers_in_one()
    alike = len(medium.g) >= lasers and len(set(medium.g[:lasers])) == 1
    if not alike or np.ptp(medium.sigma_t[:lasers], axis=0).any():
        raise InputError("the lasers share no paths", allowed="three with one sigma_t and g, or a monochrome variant")
    sigma_t, albedo = tables(medium, lasers)
    phase = {"type": "hg", "g": medium.g[0]}
    if sigma_t.size == 1:
        values = {"sigma_t": sigma_t.item(), "albedo": colour(tuple(albedo.ravel()))}
        return {"type": "homogeneous", **values, "has_spectral_extinction": False, "phase": phase}
    to_world = mi.ScalarTransform4f().translate(list(medium.low)).scale(list(medium.high - medium.low))

    def volume(values: F32) -> dict[str, Any]:
        grid = mi.VolumeGrid(np.ascontiguousarray(values, np.float32))
        look_up = {"filter_type": "trilinear", "wrap_mode": "clamp", "raw": True}
        return {"type": "gridvolume", "grid": grid, "to_world": to_world, **look_up}

    values = {"sigma_t": volume(sigma_t[..., None]), "albedo": volume(np.moveaxis(albedo, 0, -1))}
    return {"type": "heterogeneous", **values, "has_spectral_extinction": False, "phase": phase}


def tables(medium: Medium, lasers: int) -> tuple[F32, F32]:
    """(nz, ny, nx) sigma_t and (lasers, nz, ny, nx) albedo, for linear interpolation of both.

    Ours is linear in sigma_s, Mitsuba in albedo: where the albedo varies, voxels are parted into `FINER`^3 (an odd
    number keeps the old centres, and sigma_t is what it was), which leaves a `FINER`^2-th of the difference.
    """
    sigma_t, albedo = medium.sigma_t[0], medium.albedo[:lasers]
    if not np.ptp(albedo.reshape(lasers, -1), axis=1).any():
        return sigma_t, albedo
    finer = parted(sigma_t)
    found = np.zeros((lasers, *finer.shape), np.float32)
    for own, out in zip(albedo, found, strict=True):
        np.divide(parted(sigma_t * own), finer, out=out, where=finer > 0)
    return finer, found


def parted(values: F32) -> F32:
    """Cell-centred values at the centres of cells a `FINER`-th as wide: linear between, clamped outside the centres."""
    for axis, count in enumerate(values.shape):
        place = np.clip((np.arange(FINER * count) + 0.5) / FINER - 0.5, 0, count - 1)
        low = np.minimum(place.astype(int), max(count - 2, 0))
        share = (place - low).astype(values.dtype).reshape([-1 if k == axis else 1 for k in range(values.ndim)])
        high = np.minimum(low + 1, count - 1)
        values = values.take(low, axis) * (1 - share) + values.take(high, axis) * share
    return values


def emitter(light: Directional | Uniform | Environment | dict[str, Any]) -> dict[str, Any]:
    """Mitsuba's description of a light."""
    if isinstance(light, Uniform):
        return {"type": "constant", "radiance": colour(light.colour, light.radiance)}
    if isinstance(light, Environment):
        return {"type": "envmap", "bitmap": mi.Bitmap(environment_map(light))}
    if isinstance(light, Directional):
        if light.edge_side is not None:
            raise InputError("Mitsuba's own directional light has no shadow edge", value=light.name)
        direction, irradiance = list(light.direction), colour(light.colour, light.irradiance)
        return {"type": "directional", "direction": direction, "irradiance": irradiance}
    return dict(light)


def colour(values: Colour, scale: float = 1.0) -> float | dict[str, Any]:
    """One value a laser for Mitsuba's variant of today."""
    scaled = [scale * float(value) for value in values]
    return {"type": "rgb", "value": scaled[:3]} if lasers_in_one() == 3 else scaled[0]


def environment_map(light: Environment) -> F32:
    """(rows, 2 rows, lasers) radiance from the directions of an environment map's pixels (`map_directions`)."""
    sharpest = max([lobe.sharpness for lobe in light.lobes], default=1.0)
    rows = max(16, math.ceil(math.pi * math.sqrt(sharpest / (4 * LOBE_ERROR))))
    lasers = lasers_in_one()
    towards = map_directions(rows, 2 * rows)
    radiance = np.broadcast_to(np.array(light.constant[:lasers], float), (*towards.shape[:2], lasers)).copy()
    for lobe in light.lobes:
        cosine = towards @ (np.asarray(lobe.direction, float) / np.linalg.norm(lobe.direction))
        radiance += np.exp(lobe.sharpness * (cosine - 1.0))[..., None] * np.array(lobe.radiance[:lasers])
    return radiance.astype(np.float32)


def map_directions(rows: int, columns: int) -> F64:
    """(rows, columns, 3) directions of the pixels of Mitsuba's `envmap`: the poles, along y, are the first and the last
    row; columns are centred and run from -z over +x.
    """
    polar = np.linspace(0, math.pi, rows)[:, None]
    around = 2 * math.pi * (np.arange(columns) + 0.5) / columns
    x, z = np.sin(polar) * np.sin(around), -np.sin(polar) * np.cos(around)
    return np.stack([x, np.broadcast_to(np.cos(polar), x.shape), z], axis=-1)


def sensor(camera: PinholeCamera, window: Window | None) -> dict[str, Any]:
    """Mitsuba's description of a camera without distortion, its principal point in the picture's middle."""
    film: dict[str, Any] = {
        "type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"},
        "pixel_format": "rgb" if lasers_in_one() == 3 else "luminance", "component_format": "float32",
    }  # fmt: skip
    if window is not None:
        keys = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
        film |= dict(zip(keys, window, strict=True))
    position = camera.position
    view = mi.ScalarTransform4f().look_at(
        origin=list(position), target=list(position + camera.pose[2, :3]), up=list(-camera.pose[1, :3])
    )
    angle = float(np.degrees(2 * np.arctan(camera.width / 2 / camera.focal[0])))
    return {
        "type": "perspective", "fov": angle, "fov_axis": "x", "to_world": view, "film": film,
        "sampler": {"type": "independent"},
    }  # fmt: skip
