"""Efficiency of the estimators of R_d and of spot images, per decade below the peak: 1 / (variance x time).

On `quick` and on a ball of 60 mm with a dark vein. R_d: columns of the truth, from what leaves near each vertex, by the
walk without windows (one majorant for all; Russian roulette below a tenth of the power), with local majorants where
they save time, and with weight windows of growing effort. Images: one spot seen by one camera at one pixel a vertex's
footprint, by the analogue walk (exits alone), lobe connections, lobe connections with windows, and on `quick` by stock
`volpath`, which starts at the camera and connects to a spot light at the boundary. The truth of each is a long run with
windows (and lobe connections) of its own photons.

The variance is that of 16 replicates, relative to the truth's square, averaged over the entries of a decade; seconds
are the processor's, all threads', since other programs share the machine. Every point of a curve is measured. The last
point, which gains are made of, is the mean of `TURNS` runs with seeds of their own, all estimators by turns: their
scatter is each gain's stated error, for rare bright samples make a variance that few replicates do not know.
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
SHARES = (1 / 16, 1 / 4)  # of the walks: the points of a curve before the last
TURNS = 6
SCENE = Path(__file__).parents[1] / "scenes" / "quick.toml"


@dataclass(frozen=True)
class Job:
    """An estimator: `run(walks, seed)` returns (REPLICATES, columns, entries)."""

    name: str
    walks: int
    run: Callable[[int, int], F64]


@dataclass(frozen=True)
class Measured:
    """One setting of an estimator: seconds: (runs,) of the processor, per replicate and column; variances: (runs,
    columns, DECADES) relative, of `walks` walks. Not known: nan.
    """

    name: str
    walks: int
    seconds: F64
    variances: F64

    def variance(self, known: NDArray[np.bool_]) -> F64:
        """(runs, DECADES) over the columns where `known` (columns, DECADES)."""
        total = np.where(known, self.variances, 0.0).sum(axis=1)
        return np.asarray(np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan))

    @property
    def known(self) -> NDArray[np.bool_]:
        """(columns, DECADES) what every run knows."""
        return np.asarray(np.isfinite(self.variances).all(axis=0))


def efficiency(quick: bool) -> dict[str, Any]:
    """`gain_over_analogue_by_decade`, `gain_over_volpath_by_decade`, `evenness` and `curves`."""
    figures: dict[str, Any] = {"curves": []}
    for name, obj, basis, columns in objects(quick):
        tail = "" if name == "quick" else f"_{name}"
        truth, jobs = columns_of(obj, basis, columns, quick)
        rows = compare(jobs, truth)
        figures["curves"] += curves(f"R_d, {name}", rows)
        figures |= gains(rows, "analogue", "effort 3", tail)
        truth, jobs = images(name, obj, quick)
        rows = compare(jobs, truth)
        figures["curves"] += curves(f"spot image, {name}", rows)
        figures |= gains([r for r in rows if r.name != "volpath"], "exits", "lobes, effort 10", tail)
        if name == "quick":
            figures |= gains(rows, "volpath", "lobes, effort 10", tail)
    figures |= cameras(quick)
    return figures


def cameras(quick: bool) -> dict[str, Any]:
    """`seconds_24_cameras_over_one`: processor time of the same spot's walks, by turns."""
    from disco_twin.light.sources import BeamSource
    from disco_twin.light.transport import Transport
    from disco_twin.object.build import build_object
    from disco_twin.scene.scene import load_scene
    from pipeline.geometry.camera import PinholeCamera, look_at

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


def gains(rows: Sequence[Measured], base: str, headline: str, tail: str) -> dict[str, Any]:
    """Efficiency over the estimator `base`, per setting and decade, with its relative standard error; how uneven an
    estimator's relative errors are, None where a decade is not known. Only columns count that every estimator knows.
    """
    of = {row.name: row for row in rows}  # the last of a name, that with the most walks
    known = np.all([row.known for row in of.values() if row.name != "volpath"], axis=0) & of[base].known
    cost = {n: r.variance(known) * r.seconds[:, None] for n, r in of.items()}
    mean = {n: c.mean(axis=0) for n, c in cost.items()}
    error = {n: c.std(axis=0, ddof=1) / np.sqrt(len(c)) / mean[n] for n, c in cost.items()}
    others = [n for n in of if n != base]
    ratio = {n: by_decade(mean[base] / mean[n]) for n in others}
    even = {n: np.sqrt(r.variance(r.known).mean(axis=0)) for n, r in of.items()}
    return {
        f"gain_over_{base}_by_decade{tail}": ratio[headline],
        f"gain_over_{base}_by_setting{tail}": ratio,
        f"gain_error_over_{base}_by_setting{tail}": {n: by_decade(np.hypot(error[base], error[n])) for n in others},
        f"error_by_decade_beside_{base}{tail}": {n: by_decade(e * np.sqrt(of[n].walks)) for n, e in even.items()},
        f"unevenness_beside_{base}{tail}": {
            n: float(e.max() / e.min()) if np.isfinite(e).all() else None for n, e in even.items()
        },
    }


def by_decade(values: F64) -> dict[str, float]:
    return {str(-d): float(v) for d, v in enumerate(values) if np.isfinite(v)}


def curves(title: str, rows: Sequence[Measured]) -> list[dict[str, Any]]:
    """Error against seconds, a line for each estimator and decade."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        seconds = float(row.seconds.mean())
        for d, variance in enumerate(row.variance(row.known).mean(axis=0)):
            if np.isfinite(variance):
                point = {"seconds": seconds, "error": float(np.sqrt(variance)), "settings": {"walks": row.walks}}
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


def compare(jobs: Sequence[Job], truth: F64) -> list[Measured]:
    """Every estimator once to compile, then by the clock with growing numbers of walks, all of them by turns; truth
    (columns, entries).
    """

    def once(job: Job, walks: int, seed: int) -> tuple[float, F64]:
        start = time.process_time()
        samples = job.run(walks, seed)
        seconds = time.process_time() - start
        return seconds / REPLICATES / len(truth), np.stack(
            [per_decade(samples[:, k], truth[k]) for k in range(len(truth))]
        )

    def measured(job: Job, walks: int, runs: Sequence[tuple[float, F64]]) -> Measured:
        return Measured(job.name, walks, np.array([r[0] for r in runs]), np.stack([r[1] for r in runs]))

    for job in jobs:
        job.run(max(1, job.walks // 50), 1)
    rows = []
    for point, share in enumerate(SHARES):
        for job in jobs:
            walks = max(1, round(job.walks * share))
            rows.append(measured(job, walks, [once(job, walks, 500 + point)]))
    turns = [[once(job, job.walks, 600 + turn) for job in jobs] for turn in range(TURNS)]
    return rows + [measured(job, job.walks, runs) for job, runs in zip(jobs, zip(*turns, strict=True), strict=True)]


def objects(quick: bool) -> Iterator[tuple[str, Any, Any, list[int]]]:
    """`quick` and the ball with a dark vein: name, object, hat functions of its scan, columns to look at."""
    import trimesh
    from scipy import sparse

    from disco_twin.object.build import Medium, TwinBoundary, TwinObject, build_object, build_scan, hat_basis
    from disco_twin.scene.scene import load_scene

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
        TwinObject(ball, TwinBoundary("rough", 1.3, 0.3), medium),
        sparse.eye_array(len(ball.vertices)).tocsr(),
        list(facing),
    )


def columns_of(obj: Any, basis: Any, columns: Sequence[int], quick: bool) -> tuple[F64, list[Job]]:
    """R_d's columns: the truth, and the walk without splitting and with it."""
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

    scale = 2 if quick else 5
    truth = run(10.0)(2000 * scale, 9).mean(axis=0)
    jobs = [Job("analogue", 2000 * scale, run(None, local=False))]
    if transport.uses_local_majorants():
        jobs.append(Job("local majorants", 2000 * scale, run(None)))
    return truth, jobs + [Job(f"effort {e:g}", max(20, int(1800 * scale / e)), run(e)) for e in EFFORTS]


def images(name: str, obj: Any, quick: bool) -> tuple[F64, list[Job]]:
    """A spot's image, at one pixel a vertex's footprint, by every estimator; volpath on `quick` alone."""
    from disco_twin.light.importance import Splitting
    from disco_twin.light.sources import BeamSource
    from disco_twin.light.transport import CameraLobe, Transport
    from pipeline.geometry.camera import PinholeCamera, look_at

    obj = obj.of_lasers([0])
    size = float(np.abs(obj.mesh.vertices).max()) / 18.0  # of quick's stone
    pose = look_at((390.0, -120.0, 190.0), (0.0, 0.0, 0.0))
    camera = PinholeCamera(48, 32, np.full(2, 62.0 / 0.176 / size), np.array([24.0, 16.0]), np.zeros(5), pose)
    origin, radius = np.array([590.0, 60.0, 110.0]), 1.0
    axis = -origin / np.linalg.norm(origin)
    tags = np.tile(origin, (REPLICATES, 1)), np.tile(axis, (REPLICATES, 1))
    entries = np.tile(-axis * 17.0 * size, (REPLICATES, 1))
    transports = {"exits": Transport(obj, lobe=CameraLobe(100.0, 0.0, 0.0), local=False), "lobes": Transport(obj)}

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

    scale = 1 if quick else 4
    truth = run("lobes", 10.0)(1000 * scale, 9).mean(axis=0)
    jobs = [Job("exits", 4000 * scale, run("exits", None)), Job("lobes", 2000 * scale, run("lobes", None))]
    for effort in EFFORTS[1:]:
        jobs.append(Job(f"lobes, effort {effort:g}", max(20, int(1000 * scale / effort)), run("lobes", effort)))
    if name == "quick":
        jobs.append(volpath_images(obj, camera, origin, radius, truth, scale))
    return truth, jobs


def volpath_images(obj: Any, camera: Any, origin: F64, radius: float, truth: F64, scale: int) -> Job:
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

        return Job("volpath", 4 * scale, volpath)
