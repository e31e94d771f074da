"""Efficiency of the estimators of R_d and of spot images, per decade below the peak: 1 / (variance x time).

On `quick` and on a ball of 60 mm with a dark vein. R_d: columns of the truth, from what leaves near each vertex, by the
walk without windows (one majorant for all; Russian roulette below a tenth of the power), with local majorants where
they save time, and with weight windows of growing effort. Images: one spot seen by one camera at one pixel a vertex's
footprint, by the analogue walk (exits alone), lobe connections, lobe connections with windows, and on `quick` by stock
`volpath`, which starts at the camera and connects to a spot light at the boundary. The truth of each is a long run with
windows (and lobe connections) of its own photons.

The variance is that of 16 replicates, relative to the truth's square, averaged over the entries of a decade; seconds
are the processor's, all threads', since other programs share the machine. Every point of a curve is measured.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

REPLICATES, DECADES, LASER = 16, 5, 0
EFFORTS = (1.1, 1.25, 3.0, 10.0, 30.0, 100.0)
SHARES = (1 / 16, 1 / 4, 1.0)  # of the walks, the points of a curve; ratios are those of the last
SCENE = Path(__file__).parents[1] / "scenes" / "quick.toml"


@dataclass(frozen=True)
class Measured:
    """One setting of an estimator: processor seconds and relative variance per decade of a run of `walks` walks."""

    name: str
    walks: int
    seconds: float
    variance: F64

    @property
    def efficiency(self) -> F64:
        return np.asarray(1.0 / (self.variance * self.seconds))


def efficiency(quick: bool) -> dict[str, Any]:
    """`gain_over_analogue_by_decade`, `gain_over_volpath_by_decade`, `evenness` and `curves`."""
    figures: dict[str, Any] = {"curves": []}
    for name, obj, basis, columns in objects(quick):
        rows = list(columns_of(obj, basis, columns, quick))
        figures["curves"] += curves(f"R_d, {name}", rows)
        figures |= gains(rows, "analogue", "" if name == "quick" else f"_{name}")
        rows = list(images(name, obj, quick))
        figures["curves"] += curves(f"spot image, {name}", rows)
        figures |= gains([r for r in rows if r.name != "volpath"], "exits", "" if name == "quick" else f"_{name}")
        if name == "quick":
            figures |= gains([r for r in rows if r.name in ("volpath", "lobes", "lobes, effort 1.25")], "volpath", "")
    figures |= cameras(quick)
    return figures


def cameras(quick: bool) -> dict[str, Any]:
    """`seconds_24_cameras_over_one`: processor time of the same spot's walks, by turns."""
    from disco_twin.light.sources import BeamSource
    from disco_twin.light.transport import Transport
    from disco_twin.object.build import build_object
    from disco_twin.scene import load_scene
    from pipeline.calibrate.camera import PinholeCamera, look_at

    transport = Transport(build_object(load_scene(SCENE, faults=False)))
    ring = []
    for k in range(24):
        place = 470.0 * np.array([np.cos(k * np.pi / 12), np.sin(k * np.pi / 12), 0.45]) / np.hypot(1.0, 0.45)
        pose = look_at(tuple(place), (0.0, 0.0, 0.0))
        ring.append(PinholeCamera(192, 124, np.full(2, 62.0 / 0.044), np.array([96.0, 62.0]), np.zeros(5), pose))
    origin = np.array([[590.0, 60.0, 110.0]])
    axis = -origin / np.linalg.norm(origin)

    def seconds(views: list[PinholeCamera], walks: int, seed: int) -> float:
        start = time.process_time()
        transport.trace(
            lambda group: BeamSource(origin, axis, 1.0, np.ones((1, len(group)))), 1, walks, seed=seed, cameras=views
        )
        return time.process_time() - start

    walks = 100_000 if quick else 400_000
    ratios = []
    for turn in range(6):  # the first compiles
        one, many = (seconds(views, walks, turn) for views in (ring[:1], ring))
        ratios.append(many / one)
    return {
        f"seconds_24_cameras_over_one{tail}": float(pick(ratios[1:]))
        for tail, pick in (("", np.median), ("_min", np.min), ("_max", np.max))
    }


def gains(rows: Sequence[Measured], base: str, tail: str) -> dict[str, Any]:
    """Efficiency over the estimator `base`, per setting and decade; how uneven its relative errors are."""
    of = {row.name: row for row in rows}  # the last of a name, that with the most walks
    ratio = {n: by_decade(r.efficiency / of[base].efficiency) for n, r in of.items() if n != base}
    even = {n: float(np.sqrt(np.nanmax(r.variance) / np.nanmin(r.variance))) for n, r in of.items()}
    first = "effort 3" if "effort 3" in ratio else "lobes"
    return {
        f"gain_over_{base}_by_decade{tail}": ratio[first],
        f"gain_over_{base}_by_setting{tail}": ratio,
        f"unevenness_beside_{base}{tail}": even,
    }


def by_decade(values: F64) -> dict[str, float]:
    return {str(-d): float(v) for d, v in enumerate(values) if np.isfinite(v)}


def curves(title: str, rows: Sequence[Measured]) -> list[dict[str, Any]]:
    """Error against seconds, a line for each estimator and decade."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        for d, variance in enumerate(row.variance):
            if np.isfinite(variance):
                point = {"seconds": row.seconds, "error": float(np.sqrt(variance)), "settings": {"walks": row.walks}}
                found.setdefault(f"{title}: {row.name}, decade {-d}", []).append(point)
    return [{"name": name, "points": points} for name, points in found.items()]


def per_decade(samples: F64, truth: F64) -> F64:
    """(DECADES,) mean relative variance over the entries of a decade; samples (REPLICATES, ...), truth (...)."""
    decade = np.floor(-np.log10(np.maximum(truth, 1e-300) / truth.max()))
    found = []
    for d in range(DECADES):
        part = samples[:, decade == d]
        # Fewer entries, or fewer samples that hit anything, say nothing about a variance.
        enough = part.shape[1] >= 4 and np.count_nonzero(part) >= 50
        found.append(np.mean(part.var(axis=0, ddof=1) / truth[decade == d] ** 2) if enough else np.nan)
    return np.array(found)


def measured(name: str, walks: int, run: Callable[[int, int], F64], truth: F64, seed: int = 500) -> Iterator[Measured]:
    """Run `run(walks, seed)`, which returns (REPLICATES, columns, entries), once to compile, then by the clock with
    growing numbers of walks.
    """
    run(max(1, walks // 50), 1)
    for point, share in enumerate(SHARES):
        count = max(1, round(walks * share))
        start = time.process_time()
        samples = run(count, seed + point)
        seconds = time.process_time() - start
        variances = [per_decade(samples[:, k], truth[k]) for k in range(len(truth))]
        known = np.isfinite(variances)
        mean = np.where(known, variances, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        yield Measured(name, count, seconds / REPLICATES / len(truth), np.where(known.any(axis=0), mean, np.nan))


def objects(quick: bool) -> Iterator[tuple[str, Any, Any, list[int]]]:
    """`quick` and the ball with a dark vein: name, object, hat functions of its scan, columns to look at."""
    import trimesh
    from scipy import sparse

    from disco_twin.object.build import Boundary, Medium, TwinObject, build_object, build_scan, hat_basis
    from disco_twin.scene import load_scene

    scene = load_scene(SCENE, faults=False)
    obj = build_object(scene)
    yield "quick", obj, hat_basis(obj.mesh, build_scan(scene, obj.mesh)), [10, 500, 900]
    ball = trimesh.creation.icosphere(subdivisions=4, radius=30.0)
    cells = 60
    axis = (np.arange(cells) + 0.5) - 30.0
    _, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    vein = np.exp(-(((x - 10 + 4 * np.sin(y / 6)) / 1.5) ** 2))  # a sheet, 10 mm from the middle, of a few mm
    absorption, scattering = 0.002 + 0.3 * vein, 1.0 + 0.5 * vein
    sigma_t = (absorption + scattering)[None].astype(np.float32)
    albedo = (scattering / (absorption + scattering))[None].astype(np.float32)
    medium = Medium(sigma_t, albedo, np.full(3, -30.0), np.full(3, 30.0), (0.0,))
    facing = (
        int(np.argmax(ball.vertices[:, 0])),
        int(np.argmax(-ball.vertices[:, 0])),
        int(np.argmax(ball.vertices[:, 1])),
    )
    yield (
        "dark_vein",
        TwinObject(ball, Boundary("rough", 1.3, 0.3), medium),
        sparse.eye_array(len(ball.vertices)).tocsr(),
        list(facing),
    )


def columns_of(obj: Any, basis: Any, columns: Sequence[int], quick: bool) -> Iterator[Measured]:
    """R_d's columns without splitting and with it."""
    from disco_twin.light.importance import Splitting
    from disco_twin.light.sources import HatSource
    from disco_twin.light.transport import Transport
    from disco_twin.light.truth import hat_areas

    transport, plain = Transport(obj), Transport(obj, local=False)
    area = hat_areas(transport, basis)
    hats = np.tile(basis[:, columns].toarray().T, (REPLICATES, 1))
    entries = (hats @ transport.vertices) / hats.sum(axis=1, keepdims=True)

    def source(group: Sequence[int]) -> HatSource:
        return HatSource(transport.vertices, transport.faces, hats, len(group))

    def run(effort: float | None, local: bool = True) -> Callable[[int, int], F64]:
        split = None if effort is None else Splitting(entries, effort)

        def made(walks: int, seed: int) -> F64:
            traced = (transport if local else plain).trace(
                source, len(hats), walks, seed=seed, deposit=True, split=split
            )
            assert traced.deposits is not None
            found = traced.deposits[:, LASER] @ basis / area
            return np.asarray(found.reshape(REPLICATES, len(columns), -1))

        return made

    scale = 2 if quick else 10
    truth = run(10.0)(1000 * scale, 9).mean(axis=0)
    yield from measured("analogue", 2000 * scale, run(None, local=False), truth)
    if transport.uses_local_majorants():
        yield from measured("local majorants", 2000 * scale, run(None), truth)
    for effort in EFFORTS:
        yield from measured(f"effort {effort:g}", max(20, int(1800 * scale / effort)), run(effort), truth)


def images(name: str, obj: Any, quick: bool) -> Iterator[Measured]:
    """A spot's image, at one pixel a vertex's footprint, by every estimator; volpath on `quick` alone."""
    from disco_twin.light.importance import Splitting
    from disco_twin.light.sources import BeamSource
    from disco_twin.light.transport import Lobe, Transport
    from disco_twin.object.build import Medium, TwinObject
    from pipeline.calibrate.camera import PinholeCamera, look_at

    medium = obj.medium
    one = Medium(medium.sigma_t[:1], medium.albedo[:1], medium.low, medium.high, medium.g[:1])
    obj = TwinObject(obj.mesh, obj.boundary, one)
    size = float(np.abs(obj.mesh.vertices).max()) / 18.0  # of quick's stone
    pose = look_at((390.0, -120.0, 190.0), (0.0, 0.0, 0.0))
    camera = PinholeCamera(48, 32, np.full(2, 62.0 / 0.176 / size), np.array([24.0, 16.0]), np.zeros(5), pose)
    origin, radius = np.array([590.0, 60.0, 110.0]), 1.0
    axis = -origin / np.linalg.norm(origin)
    tags = np.tile(origin, (REPLICATES, 1)), np.tile(axis, (REPLICATES, 1))
    entries = np.tile(-axis * 17.0 * size, (REPLICATES, 1))
    transports = {"exits": Transport(obj, lobe=Lobe(100.0, 0.0, 0.0)), "lobes": Transport(obj)}

    def run(name: str, effort: float | None) -> Callable[[int, int], F64]:
        split = None if effort is None else Splitting(entries, effort)

        def made(walks: int, seed: int) -> F64:
            traced = transports[name].trace(
                lambda group: BeamSource(*tags, radius, np.ones((REPLICATES, len(group)))), REPLICATES, walks,
                seed=seed, cameras=[camera], split=split,
            )  # fmt: skip
            assert traced.images is not None
            return np.asarray(traced.images[:, 0, 0, 0].astype(float).reshape(REPLICATES, 1, -1))

        return made

    scale = 1 if quick else 5
    truth = run("lobes", 3.0)(1500 * scale, 9).mean(axis=0)
    yield from measured("exits", 4000 * scale, run("exits", None), truth)
    yield from measured("lobes", 2000 * scale, run("lobes", None), truth)
    for effort in EFFORTS[1:]:
        yield from measured(
            f"lobes, effort {effort:g}", max(20, int(1000 * scale / effort)), run("lobes", effort), truth
        )
    if name == "quick":
        yield from volpath_images(obj, camera, origin, radius, truth, scale)


def volpath_images(obj: Any, camera: Any, origin: F64, radius: float, truth: F64, scale: int) -> Iterator[Measured]:
    """The same spot by stock volpath, which starts at the camera and connects to a spot light at the boundary."""
    import mitsuba as mi

    from benchmarks.volpath import volpath_scene

    with tempfile.TemporaryDirectory() as folder:
        angle = float(np.degrees(np.arctan(radius / (np.linalg.norm(origin) - 17.0))))
        beam = {
            "type": "spot", "cutoff_angle": angle, "beam_width": 0.999 * angle, "intensity": 1.0,
            "to_world": mi.ScalarTransform4f().look_at(origin=list(origin), target=[0, 0, 0], up=[0, 0, 1]),
        }  # fmt: skip
        scene = volpath_scene(obj, camera, beam, Path(folder))

        def volpath(spp: int, seed: int) -> F64:
            made = [np.array(mi.render(scene, spp=max(1, spp), seed=1000 * seed + k)) for k in range(REPLICATES)]
            image = np.stack(made)[..., 0].reshape(REPLICATES, 1, -1).astype(float)
            return np.asarray(image * (truth.sum() / image.mean(axis=0).sum()))  # 1 W instead of 1 W/sr

        yield from measured("volpath", 4 * scale, volpath, truth)
