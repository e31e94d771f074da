"""The photon walk: error against time of a spot's response per decade, and paths per second beside stock volpath.

The scene is the shipped `quick`. Error is the relative error of the radiance averaged over blocks of 4 x 4 pixels
(about a vertex's footprint), per decade below the brightest block, against a run of many more photons of their own;
the reference's noise is taken out. `plain` connects exits only, `lobe` is what captures use.

Paths are compared on equal terms: one wavelength, the same mesh, boundary and heterogeneous medium, every path meets
the object, and each connects at the boundary: the walk's to one camera, volpath's to the light. volpath runs without
Russian roulette (its own is wrong for high albedo); the walk's acts on weights below .1, which are rare here.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

BLOCK = 4
DECADES = 4


def run(quick: bool = False) -> dict[str, Any]:
    """Keys of benchmarks.md (`walks_per_s, volpath_paths_per_s, ratio_volpath`) and `curves` of error against time."""
    from disco_twin.backend import activate

    activate()
    from disco_twin.light.transport import Lobe, Transport
    from disco_twin.object.build import build_object
    from disco_twin.scene import load_scene

    scene = load_scene(Path(__file__).parents[1] / "scenes" / "quick.toml")
    obj = build_object(scene)
    sizes = (1_000, 4_000, 16_000) if quick else (1_000, 4_000, 16_000, 64_000, 256_000)
    lobe = Lobe.of(obj.medium)
    plain = replace(lobe, reach=0.0)
    curves = spot_curves(Transport(obj), Transport(obj, lobe=plain), scene.rig, sizes, 3 if quick else 5)
    rates = throughput(obj, quick)
    return {"name": "walk", "quick": quick, "triangles": len(obj.mesh.faces), **rates, "curves": curves}


def spot_curves(lobed: Any, plain: Any, rig: Any, sizes: Sequence[int], repetitions: int) -> list[dict[str, Any]]:
    """One curve per estimator and decade: {name, points: [{seconds, seconds_min, seconds_max, error, settings}]}."""
    from disco_twin.light.sources import BeamSource
    from pipeline.calibrate.camera import PinholeCamera
    from pipeline.calibrate.projector import TwoMirrorProjector

    cameras = [PinholeCamera.from_config(c) for c in rig.cameras]
    middle = (rig.projector.steps - 1) / 2
    aims = np.array([[middle, middle], [middle * 1.15, middle * 0.9], [middle * 0.85, middle * 1.1]])
    origins, directions = TwoMirrorProjector.from_config(rig.projector).rays(aims)

    def source(group: Sequence[int]) -> BeamSource:
        return BeamSource(origins, directions, rig.projector.beam_diameter_mm / 2, np.ones((len(aims), len(group))))

    def response(transport: Any, walks: int, seed: int) -> NDArray[np.float64]:
        images = transport.trace(source, len(aims), walks, seed=seed, cameras=cameras).images[:, 0].astype(float)
        height, width = (n - n % BLOCK for n in images.shape[-2:])
        cut = images[..., :height, :width]
        shape = (*cut.shape[:-2], height // BLOCK, BLOCK, width // BLOCK, BLOCK)
        return np.asarray(cut.reshape(shape).mean(axis=(-3, -1)))

    references = [response(lobed, 4 * max(sizes), seed) for seed in (1, 2)]
    truth = np.mean(references, axis=0)
    noise = ((references[0] - references[1]) ** 2) / 4
    decade = np.floor(-np.log10(np.maximum(truth, 1e-30) / truth.max(axis=(1, 3, 4), keepdims=True)))
    estimators: dict[str, Any] = {"lobe": lobed, "plain": plain}
    points: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for walks in sizes:
        found: dict[str, list[tuple[float, NDArray[np.float64]]]] = {name: [] for name in estimators}
        for repetition in range(repetitions):  # alternating, since the machine's speed drifts
            for name, transport in estimators.items():
                start = time.perf_counter()
                image = response(transport, walks, 100 + repetition)
                found[name].append((time.perf_counter() - start, image))
        for name, runs in found.items():
            seconds = [s for s, _ in runs]
            square = np.mean([(image - truth) ** 2 for _, image in runs], axis=0) - noise
            for d in range(DECADES):
                cells = decade == d
                error = float(np.sqrt(max(square[cells].sum(), 0.0) / (truth[cells] ** 2).sum()))
                row = {
                    "seconds": statistics.median(seconds), "seconds_min": min(seconds), "seconds_max": max(seconds),
                    "error": error, "settings": {"walks_per_spot": walks},
                }  # fmt: skip
                points.setdefault((name, d), []).append(row)
    return [{"name": f"{name}, decade {-d}", "points": rows} for (name, d), rows in points.items()]


def throughput(obj: Any, quick: bool) -> dict[str, float]:
    """Paths per second of the walk and of stock volpath, alternating, in one process."""
    import mitsuba as mi

    from benchmarks.volpath import volpath_scene
    from disco_twin.light.sources import BeamSource
    from disco_twin.light.transport import Lobe, Transport
    from disco_twin.object.build import Medium, TwinObject
    from pipeline.calibrate.camera import PinholeCamera, look_at
    from pipeline.relight.lights import Uniform

    medium = obj.medium
    one = Medium(medium.sigma_t[:1], medium.albedo[:1], medium.low, medium.high, medium.g[:1])
    single = TwinObject(obj.mesh, obj.boundary, one)
    pixels, spp = 64, 8 if quick else 32
    pose = look_at((400.0, 0.0, 100.0), (0.0, 0.0, 0.0))
    wide = PinholeCamera(pixels, pixels, np.full(2, 700.0), np.full(2, pixels / 2), np.zeros(5), pose)
    tight = replace(wide, focal=np.full(2, 2400.0))  # every pixel sees the object
    transport = Transport(single, lobe=replace(Lobe.of(one), reach=0.0))
    walks = 200_000 if quick else 1_000_000

    def source(group: Sequence[int]) -> BeamSource:
        return BeamSource(np.array([[100.0, 0.0, 25.0]]), pose[None, 2, :3], 5.0, np.ones((1, 1)))

    def walk(seed: int) -> None:
        transport.trace(source, 1, walks, seed=seed, cameras=[wide])

    with tempfile.TemporaryDirectory() as folder:
        scene = volpath_scene(single, tight, Uniform(), Path(folder))
        jobs: dict[str, tuple[int, Callable[[int], Any]]] = {
            "walks_per_s": (walks, walk),
            "volpath_paths_per_s": (
                pixels * pixels * spp, lambda seed: np.array(mi.render(scene, spp=spp, seed=seed))
            ),
        }  # fmt: skip
        rates: dict[str, list[float]] = {name: [] for name in jobs}
        for repetition in range(1 + (3 if quick else 5)):  # the first compiles
            for name, (paths, job) in jobs.items():
                start = time.perf_counter()
                job(repetition)
                if repetition:
                    rates[name].append(paths / (time.perf_counter() - start))
    ratios = [a / b for a, b in zip(rates["walks_per_s"], rates["volpath_paths_per_s"], strict=True)]
    table = {**rates, "ratio_volpath": ratios}
    return {
        name + tail: pick(values)
        for name, values in table.items()
        for tail, pick in (("", statistics.median), ("_min", min), ("_max", max))
    }
