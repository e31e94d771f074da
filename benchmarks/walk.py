"""The photon walk: speed beside stock volpath and pmmc, and what splitting and lobe connections gain per decade.

Speed (benchmarks/rival.py has the problem), all programs by turns in one process: the walk connects every exit to one
camera; volpath connects every exit to the light; pmmc adds up what each tetrahedron absorbs. pmmc plays Russian
roulette as the walk does; volpath plays none (its own is wrong for high albedo), and is compared with a walk that plays
none either.

Efficiency (benchmarks/efficiency.py): 1 / (variance x time) of R_d and of spot images, per decade below the peak.
"""

from __future__ import annotations

import logging
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

log = logging.getLogger(__name__)


def run(quick: bool = False) -> dict[str, Any]:
    """Keys of benchmarks.md, and `curves` of error against time."""
    from disco_twin.light.backend import activate

    activate()
    from benchmarks.efficiency import efficiency

    return {"name": "walk", "quick": quick, **throughput(quick), **efficiency(quick)}


def throughput(quick: bool) -> dict[str, Any]:
    """Walks and paths per second, alternating; medians with `_min` and `_max`. Ratios are those of processor time, of
    each turn: other programs share the machine.
    """
    from benchmarks.rival import Pmmc, ball

    obj = ball()
    jobs = walk_jobs(obj, 200_000 if quick else 500_000)
    left_out = {}
    with tempfile.TemporaryDirectory() as folder:
        jobs["volpath_paths_per_s"] = volpath_job(obj, 2 if quick else 4, Path(folder))
        try:
            rival = Pmmc(obj)
        except ImportError as error:
            left_out["pmmc"] = str(error)
        else:
            walks = 30_000 if quick else 200_000  # its meshes are set up anew each time
            jobs["pmmc_walks_per_s"] = (walks, lambda seed: rival.absorbed(walks, seed))
        rates: dict[str, list[float]] = {name: [] for name in jobs}
        processor: dict[str, list[float]] = {name: [] for name in jobs}
        for repetition in range(1 + (2 if quick else 5)):  # the first compiles
            for name, (paths, job) in jobs.items():
                start, own = time.perf_counter(), time.process_time()
                job(repetition)
                if repetition:
                    rates[name].append(paths / (time.perf_counter() - start))
                    processor[name].append((time.process_time() - own) / paths)
    pairs = {"ratio_volpath": ("walks_without_roulette_per_s", "volpath_paths_per_s")}
    if not left_out:
        pairs["ratio_pmmc"] = ("walks_per_s", "pmmc_walks_per_s")
    for name, (ours, theirs) in pairs.items():
        rates[name] = [b / a for a, b in zip(processor[ours], processor[theirs], strict=True)]
    figures = {
        name + tail: pick(values)
        for name, values in rates.items()
        for tail, pick in (("", statistics.median), ("_min", min), ("_max", max))
    }
    return {"triangles": len(obj.mesh.faces), **figures, "left_out": left_out}


def walk_jobs(obj: Any, walks: int) -> dict[str, tuple[int, Callable[[int], Any]]]:
    """The walk with one camera connected at the exits, with Russian roulette and without."""
    from disco_twin.light import splitting
    from disco_twin.light.sources import BeamSource
    from disco_twin.light.transport import CameraLobe, Transport
    from pipeline.geometry.camera import PinholeCamera, look_at

    pose = look_at((30.0, 0.0, 400.0), (0.0, 0.0, 0.0))
    camera = PinholeCamera(64, 64, np.full(2, 600.0), np.full(2, 32.0), np.zeros(5), pose)
    transport = Transport(obj, lobe=replace(CameraLobe.of(obj.medium, 0.3), reach=0.0))

    def source(_: Any) -> BeamSource:
        return BeamSource(np.array([[0.1, 0.07, 100.0]]), np.array([[0.0, 0.0, -1.0]]), 1e-3, np.ones((1, 1)))

    def walk(seed: int) -> None:
        transport.trace(source, 1, walks, seed=seed, cameras=[camera])

    def without_roulette(seed: int) -> None:
        usual, splitting.PLAIN_TARGET = splitting.PLAIN_TARGET, 1e-30
        try:
            walk(seed)
        finally:
            splitting.PLAIN_TARGET = usual

    return {"walks_per_s": (walks, walk), "walks_without_roulette_per_s": (walks, without_roulette)}


def volpath_job(obj: Any, spp: int, folder: Path) -> tuple[int, Callable[[int], Any]]:
    """Stock volpath from a camera whose every pixel sees the ball, towards uniform light."""
    import mitsuba as mi

    from benchmarks.volpath import volpath_scene
    from pipeline.geometry.camera import PinholeCamera, look_at
    from pipeline.relight.lights import Uniform

    pixels = 64
    pose = look_at((30.0, 0.0, 400.0), (0.0, 0.0, 0.0))
    view = PinholeCamera(pixels, pixels, np.full(2, 2400.0), np.full(2, pixels / 2), np.zeros(5), pose)
    scene = volpath_scene(obj, view, Uniform(), folder)
    return pixels * pixels * spp, lambda seed: np.array(mi.render(scene, spp=spp, seed=seed))
