"""Reference images of `quick`: noise over the image against processor seconds, per light and view, old against new.

Old is the plain walk from the light, connected as captures are; new is what `disco_twin.light.rendering` does. Both run
by turns. The variance of an image goes with the inverse of its time, so one number tells all: processor seconds, for
both views together, until the noise over a view's image is 3 %.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

SCENE = Path(__file__).parents[1] / "scenes" / "quick.toml"
NOISE = 0.03
PLAIN = 100_000  # walks a half of the old way, in one turn; the others take about as long
EVEN, LED, PIXEL = 40_000, 8_000, 8  # of the new: from the light, with windows, of each pixel
TURNS = 3

Run = Callable[[int, int], F64]  # (walks a half, turn) -> (views,) squared noise


def run(quick: bool = False) -> dict[str, Any]:
    """`references` holds a row {light, view, old_s, new_s, gain} of processor seconds to 3 % noise, with the standard
    error of the gain over turns; `curves` the measured points; `old_s`, `new_s` are the sums over lights of the noisier
    view's.
    """
    from disco_twin.light.backend import activate

    activate()
    from disco_twin.light.transport import Transport
    from disco_twin.object.build import build_object
    from disco_twin.scene.scene import load_scene
    from pipeline.geometry.camera import PinholeCamera

    scene = load_scene(SCENE, faults=False)
    transport = Transport(build_object(scene))
    cameras = [PinholeCamera.from_config(view) for view in scene.relight.views]
    names = [view.name for view in scene.relight.views]
    rows: list[dict[str, Any]] = []
    curves: list[dict[str, Any]] = []
    total = {"old_s": 0.0, "new_s": 0.0}
    for light in scene.relight.lights if not quick else scene.relight.lights[:2]:
        jobs = ways(transport, light, cameras)
        cost: dict[str, list[F64]] = {name: [] for name in jobs}
        for turn in range(1 + (2 if quick else TURNS)):  # the first compiles
            for name, (walks, job) in jobs.items():
                count = walks if turn else max(1, walks // 50)
                start = time.process_time()
                squared = job(count, 1 + turn)
                seconds = time.process_time() - start
                if not turn:
                    continue
                cost[name].append(seconds * squared / NOISE**2)
                for view, value in zip(names, squared, strict=True):
                    point = {"seconds": seconds, "error": float(np.sqrt(value)), "settings": {"walks": 2 * count}}
                    curves.append({"name": f"{light.name}@{view}: {name}", "points": [point]})
        old, new = (np.stack(cost[name]) for name in ("old", "new"))
        for k, view in enumerate(names):
            ratio = old[:, k] / new[:, k]
            rows.append(
                {
                    "light": light.name,
                    "view": view,
                    "old_s": float(old[:, k].mean()),
                    "new_s": float(new[:, k].mean()),
                    "gain": float(old[:, k].mean() / new[:, k].mean()),
                    "gain_se": float(ratio.std(ddof=1) / np.sqrt(len(ratio))),
                }
            )
        total["old_s"] += float(old.mean(axis=0).max())
        total["new_s"] += float(new.mean(axis=0).max())
    return {"name": "references", "quick": quick, **total, "references": rows, "curves": merged(curves)}


def ways(transport: Any, light: Any, cameras: list[Any]) -> dict[str, tuple[int, Run]]:
    """Walks a half and the job, of both ways."""
    from disco_twin.light.references import noise_of
    from disco_twin.light.rendering import Sky, from_light, from_pixels
    from disco_twin.light.sources import light_source
    from pipeline.relight.lights import Beam

    def old(walks: int, turn: int) -> F64:
        streams = np.array([2 * turn, 2 * turn + 1], np.uint32)
        traced = transport.trace(
            lambda group: light_source(light, transport.radius, group), 2, walks,
            seed=21, streams=streams, cameras=cameras, layers=2,
        )  # fmt: skip
        assert traced.images is not None
        return np.array([noise_of(traced.images[:, :, c]) ** 2 for c in range(len(cameras))])

    sky = isinstance(light, Sky)
    renders = [
        from_pixels(transport, light, camera, NOISE, 22) if sky else from_light(transport, light, camera, 22)
        for camera in cameras
    ]

    def new(walks: int, turn: int) -> F64:
        return np.array([noise_of(render(walks, turn)) ** 2 for render in renders])

    return {"old": (PLAIN, old), "new": (PIXEL if sky else LED if isinstance(light, Beam) else EVEN, new)}


def merged(curves: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One curve a name."""
    found: dict[str, list[dict[str, Any]]] = {}
    for curve in curves:
        found.setdefault(curve["name"], []).extend(curve["points"])
    return [{"name": name, "points": points} for name, points in found.items()]
