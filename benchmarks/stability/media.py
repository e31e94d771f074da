"""What a scene may be made of: coefficients at either end of what is allowed, and what single precision cannot hold."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh

from benchmarks.stability.case import Ends, Family, relative
from benchmarks.stability.material import scene_with
from disco_twin.experiment.experiment import Experiment, rounding_warning
from disco_twin.light.majorants import greatest_in_cells, local_majorants
from disco_twin.object import shapes
from disco_twin.object.build import Medium, TwinBoundary, TwinObject, build_object, require_places
from disco_twin.run.scan import require_scattering
from hw.base.arrays import F64

FAMILY = Family("media")
BASE = "object.medium.base"


def built(changes: dict[str, Any]) -> TwinObject:
    """The object of a scene; coarse, for time."""
    fine, shapes.SUBDIVISIONS = shapes.SUBDIVISIONS, 3
    try:
        return build_object(scene_with(changes))
    finally:
        shapes.SUBDIVISIONS = fine


def kept(key: str, name: str, value: float) -> float:
    """Relative error of what the walk's tables hold of a coefficient, of an albedo by what is absorbed."""
    medium = built({key: value}).medium
    held = float(np.ravel(getattr(medium, name)[0])[0])
    return relative(1 - np.float64(held), 1 - value) if name == "albedo" and value < 1 else relative(held, value)


for value, ends in (
    (1e-6, Ends.RIGHT),
    (1e4, Ends.RIGHT),
    (1.1e4, Ends.REFUSED),
    (-1.0, Ends.REFUSED),
    (np.inf, Ends.REFUSED),
):
    FAMILY.case(f"sigma_t {value:g} / mm", "held to 1e-6, or refused with the range", f"{value:g}", 1e-6, ends=ends)(
        partial(kept, f"{BASE}.sigma_t_per_mm", "sigma_t", value)
    )
for value, ends in (
    (0.0, Ends.RIGHT),
    (1.0, Ends.RIGHT),
    (1 - 1e-6, Ends.RIGHT),
    (1 - 1e-7, Ends.EITHER),
    (1 + 1e-9, Ends.REFUSED),
):
    FAMILY.case(
        f"albedo {value:.10g}",
        "what is absorbed is held to 2 %, or refused with the range",
        f"1 - {1 - value:.1e}",
        0.02,
        ends=ends,
    )(partial(kept, f"{BASE}.albedo", "albedo", value))


def g_kept(value: float) -> float:
    held = float(np.float32(built({"object.medium.g": value}).medium.g[0]))
    return relative(held, value) if abs(held) < 1 else np.inf


for value, ends in ((0.99, Ends.RIGHT), (-0.99, Ends.RIGHT), (1 - 1e-9, Ends.REFUSED), (1.0, Ends.REFUSED)):
    FAMILY.case(
        f"g {value:.10g}",
        "held to 1e-6 and below 1 in single precision, or refused",
        f"1 - {1 - abs(value):.1e}",
        1e-6,
        ends=ends,
    )(partial(g_kept, value))


def unscattered(sigma_t: float, albedo: float) -> float:
    """An object that nothing is seen of."""
    require_scattering(Experiment(scene_with({f"{BASE}.sigma_t_per_mm": sigma_t, f"{BASE}.albedo": albedo})))
    return 1.0


for sigma_t, albedo in ((0.0, 0.9), (1.0, 0.0)):
    FAMILY.case(
        f"an object that scatters nothing, albedo {albedo:g}",
        "refused before the capture",
        f"sigma_t {sigma_t:g} / mm",
        ends=Ends.REFUSED,
        says="object.medium: nothing scatters light",
    )(partial(unscattered, sigma_t, albedo))


def told(size: float, sigma_t: float, most: float) -> float:
    """1 where rounding of more than `most` is neither refused nor told."""
    mesh = trimesh.creation.box((size, size, size))
    s = np.full((1, 1, 1, 1), sigma_t, np.float32)
    low, high = np.asarray(mesh.bounds, np.float64)
    obj = TwinObject(mesh, TwinBoundary("rough", 1.3, 0.3), Medium(s, np.full_like(s, 0.9), low, high, (0.0,)))
    share = sigma_t * float(np.spacing(np.float32(size / 2)))
    require_places(obj)
    return float(share > most and rounding_warning(obj) is None)


for size, sigma_t, ends in (
    (1.0, 1e4, Ends.RIGHT),
    (20.0, 1e4, Ends.RIGHT),
    (300.0, 10.0, Ends.RIGHT),
    (300.0, 1e4, Ends.REFUSED),
):
    FAMILY.case(
        f"{sigma_t:g} free paths a mm in {size:g} mm",
        "rounding of places is below half a per cent of a free path, told, or refused with the limit",
        f"free path {1 / sigma_t / size:.0e} of the size",
        ends=ends,
    )(partial(told, size, sigma_t, 0.005))


def mixed_off(width: float, cell: float) -> float:
    """Optical depth of a crack across a ball, relative, along the middle's voxels."""
    obj = built(
        {
            "object.medium.features": [
                {
                    "kind": "crack",
                    "sigma_t_per_mm": 100.0,
                    "albedo": 0.5,
                    "width_mm": width,
                    "waviness_mm": 0.0,
                    "radius_mm": 30.0,
                }
            ],
            "object.medium.cell_mm": cell,
            f"{BASE}.sigma_t_per_mm": 1e-6,
        }
    )
    grid, size = obj.medium.sigma_t[0], obj.medium.high - obj.medium.low
    middle = grid[grid.shape[0] // 2, grid.shape[1] // 2]
    return relative(middle.sum() * size[0] / grid.shape[2], 100 * width)


for width, cell in ((2.0, 0.5), (0.1, 0.5), (0.05, 0.5)):
    FAMILY.case(
        f"a crack of {width:g} mm in voxels of {cell:g} mm",
        "its optical depth to 10 %",
        f"{width / cell:.2g} of a voxel",
        0.1,
        slow=width > 0.05,
    )(partial(mixed_off, width, cell))


def voxels(change: Any) -> float:
    """A scene of two voxel files, changed before they are read."""
    arrays = {"sigma_t": np.full((4, 4, 4), 1.0, np.float32), "albedo": np.full((4, 4, 4), 0.9, np.float32)}
    change(arrays)
    with TemporaryDirectory() as folder:
        for name, array in arrays.items():
            np.save(Path(folder) / f"{name}.npy", array)
        medium = built(
            {
                BASE: {
                    "kind": "grid",
                    "low_mm": [-30.0] * 3,
                    "high_mm": [30.0] * 3,
                    "sigma_t_file": f"{folder}/sigma_t.npy",
                    "albedo_file": f"{folder}/albedo.npy",
                },
            }
        ).medium
    return relative(medium.sigma_t[0], arrays["sigma_t"]) + relative(medium.albedo[0], arrays["albedo"])


def put(name: str, value: float) -> Any:
    return lambda arrays: arrays[name].__setitem__((1, 2, 3), value)


for name, change, ends in (
    ("contrast of 1e6", put("sigma_t", 1e-6), Ends.RIGHT),
    ("a void", put("sigma_t", 0.0), Ends.RIGHT),
    ("a voxel of 1e5 / mm", put("sigma_t", 1e5), Ends.REFUSED),
    ("a voxel that is not finite", put("sigma_t", np.nan), Ends.REFUSED),
    ("a negative voxel", put("sigma_t", -1.0), Ends.REFUSED),
    ("an albedo above 1", put("albedo", 1.0001), Ends.REFUSED),
):
    FAMILY.case(f"voxels: {name}", "held as they are, or refused", "1 of 64", 1e-6, ends=ends)(partial(voxels, change))


def majorant_broken(grid: F64) -> float:
    """How many cells have a local majorant below what a place in them, or a stretch away, may be."""
    low, high = np.full(3, -10.0), np.full(3, 10.0)
    cells, cell = 24, 20.0 / 16
    corner = np.full(3, -15.0)
    inside = np.stack(np.meshgrid(*[np.arange(6, 18)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    found = local_majorants(grid, low, high, corner, cell, cells, inside)
    if found is None:
        return 0.0
    within = greatest_in_cells(grid, low, high, corner, cell, cells)
    reach = int(np.floor(found.stretch / cell))
    broken = 0
    for shift in np.ndindex(3, 3, 3):
        step = (np.array(shift) - 1) * reach
        moved = np.roll(within, tuple(step), axis=(0, 1, 2))
        middle = (slice(reach, cells - reach),) * 3
        broken += int((moved[middle] > found.rate[middle] * (1 + 1e-6)).sum())
    return float(broken)


def spikes_broken(contrast: float) -> float:
    """Of a grid with some dense voxels."""
    return majorant_broken(np.where(np.random.default_rng(0).random((16, 16, 16)) < 0.02, 1.0, 1.0 / contrast))


for contrast in (1e2, 1e6, 1e12):
    FAMILY.case(
        f"local majorants, contrast {contrast:.0e}", "nowhere exceeded within their stretch", f"{contrast:.0e}"
    )(partial(spikes_broken, contrast))
FAMILY.case("a scene of an eta of 3.5", "refused with the range", "eta 3.5", ends=Ends.REFUSED)(
    lambda: float(scene_with({"object.boundary.eta": 3.5}).seed)
)
FAMILY.case("a scene of an alpha of .01", "refused with the range", "alpha .01", ends=Ends.REFUSED)(
    lambda: float(scene_with({"object.boundary.alpha": 0.01}).seed)
)
