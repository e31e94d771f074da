"""New lights a second on a finished model of a thesis-sized object, and how far off: factorised against dense.

The model: the quick scene's object scanned with 8924 vertices (the scanner's mesh has a few more or less), three
wavelengths, tilt. Its R_d(x, y) = a(x) a(y) f(|x - y|), with a bright narrow and a wide part in f, dark veins of 1.2 mm
in a, and errors of single entries, since a reconstruction has them. What is timed begins with the flux that a light
sends through the vertices and ends with radiosity and its moments there. Beside it: the flux itself with shadows,
and the image of one view from the moments. Local kernels on texels are no part of any model yet: `kernels` is 0, and
`pipeline.model.factorise.FACTORISE` is where a term on texels says how it is made fast.

error: rms over the surface of the radiosity, all wavelengths, less the dense model's in float64, over the rms of that.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.distance import cdist

from disco_twin.experiment.experiment import Experiment
from disco_twin.scene.scene import load_scene
from hw.base.arrays import F64
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.mesh import RayMesh
from pipeline.model.factorise import Truncation, factorised
from pipeline.model.factorised import FactorisedTerm
from pipeline.model.radiosity import RadiosityTerm
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.relight.on_mesh import LightOnMesh

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "quick.toml"
VERTICES, SMALL = 8924, 500
OTHERS = ((128, 16, 4), (128, 16, 8), (224, 32, 4), (224, 32, 8))
WIDE_MM, NARROW_MM = (6.0, 5.0, 4.0), 0.8  # lengths over which R_d falls, by wavelength
VEIN_MM, SPACING_MM, NOISE = 1.2, 9.0, 0.03
REPEATS = 20


def model_on(mesh: trimesh.Trimesh, lasers: int = 3) -> RelightableModel:
    """A model in closed form with what a reconstruction's has: veins, noise, slopes."""
    points, rng = np.asarray(mesh.vertices, np.float64), np.random.default_rng(1)
    waves = np.sin(2 * np.pi * points @ rng.standard_normal((3, 3)) / (SPACING_MM * np.sqrt(3)))
    vein = np.exp(-0.5 * (waves * SPACING_MM / VEIN_MM) ** 2).max(axis=1)
    entries = np.empty((lasers, len(points), len(points)), np.float32)
    for low in range(0, len(points), 1024):
        rows = slice(low, low + 1024)
        distance = cdist(points[rows], points)
        for laser, wide in enumerate(WIDE_MM[:lasers]):
            dark = np.exp(-0.4 * (1 + 0.3 * laser) * vein)
            profile = 0.03 * np.exp(-distance / NARROW_MM) + 0.004 * np.exp(-distance / wide)
            noisy = 1 + NOISE * rng.standard_normal(distance.shape, np.float32)
            entries[laser, rows] = profile * np.outer(dark[rows], dark) * noisy
    for one in entries:
        one += one.T
        one *= 0.5
    slopes, at = np.tile([0.9, 0.8, 0.5, 0.3], (lasers, 1)), np.array([1.0, 3.0, 8.0, 20.0])
    term = GlobalTerm(entries, np.ones(entries.shape[1:], bool), tilt=slopes, tilt_distance=at)
    return RelightableModel(mesh, Boundary(1.3), (term,))


def cpu_seconds(work: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Median of all threads: what is left of a frame on a machine that others use, too."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return float(np.median(times))


def seconds(work: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Median."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def term_of(model: RelightableModel) -> RadiosityTerm:
    """Its only term."""
    (term,) = model.terms
    assert isinstance(term, RadiosityTerm)
    return term


def errors(term: FactorisedTerm, lights: Sequence[LightOnMesh], exact: Sequence[F64]) -> list[dict[str, float]]:
    """By light: error and its stated bound, of the radiosity and of the moments over the radiosity's rms."""
    rows = []
    for light, truth in zip(lights, exact, strict=True):
        area, points = RayMesh.of(light.mesh).vertex_areas, np.asarray(light.mesh.vertices, np.float64)
        total = np.sqrt((truth[0] ** 2 @ area).sum())
        off = np.sqrt(((term.radiosity(light.tilted_flux, points) - truth) ** 2 @ area).sum(axis=1)) / total
        bound = np.sqrt(area.sum()) * np.sqrt((term.error_bound(light.tilted_flux, area) ** 2).sum(axis=1)) / total
        rows.append(
            {"error": float(off[0]), "bound": float(bound[0]), "moments_error": float(np.linalg.norm(off[1:])),
             "moments_bound": float(np.linalg.norm(bound[1:]))}
        )  # fmt: skip
    return rows


def run(quick: bool = False) -> dict[str, Any]:
    """Figures of the chosen truncation, the dense model's beside them, a curve over the others."""
    scene = load_scene(SCENE)
    scan = scene.scan.model_copy(update={"vertices": SMALL if quick else VERTICES})
    mesh = Experiment(scene.model_copy(update={"scan": scan})).scan
    model, points = model_on(mesh), np.asarray(mesh.vertices, np.float64)
    lights, flux_s = [model.lit_by(light) for light in scene.relight.lights], {}
    for light in lights:
        flux_s[light.light.name] = seconds(lambda light=light: light.tilted_flux, 1)  # type: ignore[misc]
    exact = [term_of(model).radiosity(light.tilted_flux, points) for light in lights]
    dense_s = seconds(lambda: term_of(model).radiosity(lights[0].tilted_flux, points), 1 if not quick else 3)
    flux32, entries = lights[0].flux.astype(np.float32), term_of(model).arrays()["reflectance"]
    plain_s = seconds(lambda: [q @ r for q, r in zip(flux32, entries, strict=True)], 5)

    def point(cut: Truncation) -> tuple[FactorisedTerm, dict[str, Any], list[dict[str, float]]]:
        start = time.perf_counter()
        term = term_of(factorised(model, cut))
        assert isinstance(term, FactorisedTerm)
        prepared = time.perf_counter() - start
        term.radiosity(lights[0].tilted_flux, points)
        took = seconds(lambda: term.radiosity(lights[0].tilted_flux, points))
        rows = errors(term, lights, exact)
        settings = asdict(cut) | {"prepared_s": round(prepared, 1)}
        return term, {"seconds": took, "error": max(r["error"] for r in rows), "settings": settings}, rows

    cut = Truncation.of(len(points))
    term, chosen, rows = point(cut)
    view = model.seen_by(PinholeCamera.from_config(scene.relight.views[0]))
    prepare_s = seconds(lambda: (view.matrix, view.tilted_matrices), 1)
    raster_s = seconds(lambda: term.image(lights[0], view))  # its radiosity is kept by light
    others = [point(Truncation(*cut))[1] for cut in (OTHERS[:2] if quick else OTHERS)]
    worst = max(range(len(rows)), key=lambda n: rows[n]["error"])
    return {
        "frames_per_s": 1 / chosen["seconds"],
        "frame_cpu_s": cpu_seconds(lambda: term.radiosity(lights[0].tilted_flux, points)),
        "relative_error": chosen["error"],
        "worst_light": lights[worst].light.name,
        "worst_bound": rows[worst]["bound"],
        "bound_holds": all(r["error"] <= r["bound"] and r["moments_error"] <= r["moments_bound"] for r in rows),
        "dense_frames_per_s": 1 / dense_s,
        "dense_without_directions_per_s": 1 / plain_s,
        "vertices": len(points),
        "kernels": 0,
        "lasers": 3,
        "truncation": asdict(cut),
        "prepare_s": chosen["settings"]["prepared_s"],
        "view_s": prepare_s,
        "raster_s": raster_s,
        "lights": [
            {"light": light.light.name, "flux_s": flux_s[light.light.name]} | row
            for light, row in zip(lights, rows, strict=True)
        ],
        "curves": [{"name": "relight", "points": [chosen, *others]}],
    }
