"""Each stage of a run against the truth, in figures that are errors: what is worse is larger.

Read from a run folder alone, without a renderer. A stage is judged on what it left for the next one, so that the first
figure that grew names the stage that made it grow:

    pose        mm, where surface points appear in the images, seen by the measured cameras and by the actual ones
    projector   mm, distance of the aimed beam's axis from the place that the actual projector hits
    spots       mm, distance of each spot's place on the scan from where the beam met the object
    samples     log10, measured R_d between spots and the vertices whose truth is known, by decade below the peak
    completion  log10, all entries of those vertices by decade; column totals, over lit and over unlit vertices
    relit       nrmse and energy of each relit image

Pose and projector are compared in the object frame as the silhouettes were understood at each turntable angle; that
frame's own error is `pose/frame mm`, and part of the spots' error.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.evaluate.entries import score_entries
from disco_twin.evaluate.scores import load_model, load_relit, usable_score
from disco_twin.evaluate.totals import lit_vertices, score_totals
from disco_twin.evaluate.true_calibration import object_frames, true_calibration
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.references import reference_path
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.faults.actual_rig import ActualRig, actual_rig
from disco_twin.light.references import LAYERS, load_reference
from disco_twin.light.truth import Truth
from pipeline.calibrate.calibration import Calibration, nominal_calibration
from pipeline.geometry.fresnel import mean_transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.mesh_file import read_scan
from pipeline.plan.plan import Plan
from pipeline.reconstruct.samples.distances import beam_footprints
from pipeline.reconstruct.samples.samples_file import load_samples
from pipeline.reconstruct.samples.spots import Spots

F64 = NDArray[np.float64]
DECADES = 3  # below the peak; fainter samples are noise


@dataclass(frozen=True)
class StageOutputs:
    """What the stages of one method's run left. `images`: (L, H, W) by (light, view), W/(mm^2 sr).

    spots: as located on the scan; values: (L, S, V) samples in mm^-2, NaN where not observed, times Tbar^2 of the
    boundary that they were divided by; exitance: (L, n, V) mm^-2, Tbar^2 R_d of the completed model for the vertices in
    `TrueRun.truth`, None where the method states none; lit: (n,) whether a spot lies in their triangles.
    """

    calibration: Calibration
    spots: Spots
    values: F64
    exitance: F64 | None
    lit: NDArray[np.bool_]
    images: dict[tuple[str, str], NDArray[np.floating[Any]]]


@dataclass(frozen=True)
class TrueRun:
    """What outputs are compared with. hits: (S, 3) mm, where beams met the object, NaN where they missed it;
    halves: (2, L, H, W) of the reference by (light, view); masks: (H, W) by view, the object's pixels without its rim.
    """

    scan: trimesh.Trimesh
    plan: Plan
    calibration: Calibration
    hits: F64
    truth: Truth
    halves: dict[tuple[str, str], NDArray[np.floating[Any]]]
    masks: dict[str, NDArray[np.bool_]]


def load_true_run(experiment: Experiment, folder: RunFolder) -> TrueRun:
    """The truth of a run: (2, L, H, W) halves of every reference, light from below the surface alone."""
    scene = experiment.scene
    actual = actual_rig(scene.rig, scene.seed)
    nominal = nominal_calibration(scene.rig, lars3_sensor(scene.rig))
    layer, views = LAYERS.index("subsurface"), scene.relight.views
    references = {
        (light.name, view.name): load_reference(reference_path(folder.twin / "references", light, view))
        for light in scene.relight.lights
        for view in views
    }
    return TrueRun(
        read_scan(folder.capture / "scan.ply"),
        experiment.plan,
        true_calibration(scene.rig, actual, nominal),
        _hits(experiment, actual),
        Truth.load(folder.twin / "truth.npz"),
        {key: reference.halves[:, layer] for key, reference in references.items()},
        {view.name: experiment.object_pixels(view).inner for view in views},
    )


def load_outputs(experiment: Experiment, folder: RunFolder, true: TrueRun, method: str = "default") -> StageOutputs:
    """What a run's stages left in WORK. Raises: InputError where a file is missing or damaged."""
    columns = load_model(folder, method).exitance_columns(true.truth.columns)
    samples = load_samples(folder.work / "samples.npz")
    relight = experiment.scene.relight
    return StageOutputs(
        Calibration.load(folder.work / "calibration.json"),
        samples.spots,
        samples.values.astype(np.float64) * mean_transmittance(samples.eta) ** 2,
        None if columns is None else np.asarray(columns.mean, np.float64),
        lit_vertices(samples)[true.truth.columns],
        {(x.name, v.name): load_relit(folder, method, x.name, v) for x in relight.lights for v in relight.views},
    )


def pose_figures(outputs: StageOutputs, true: TrueRun) -> dict[str, float]:
    """Root mean square over views and the scan's vertices; the lens counts as a part of the pose."""
    calibration, points = outputs.calibration, np.asarray(true.scan.vertices)
    misses, turned = [], []
    for j, frame in enumerate(object_frames(calibration, true.calibration)):
        moved = points @ frame[:3, :3].T + frame[:3, 3]
        turned.append(np.linalg.norm(moved - points, axis=1))
        for view in calibration.views_at(j):
            actual = true.calibration.view_camera(view)
            pixels = calibration.view_camera(view).project(points)[0] - actual.project(moved)[0]
            depth = np.linalg.norm(moved - actual.position, axis=1)
            misses.append(np.linalg.norm(pixels / actual.focal, axis=1) * depth)
    return {"pose/image mm": _rms(misses), "pose/frame mm": _rms(turned)}


def projector_figures(outputs: StageOutputs, true: TrueRun) -> dict[str, float]:
    """Root mean square over the plan's aims; each mirror move's own error counts for the spots alone."""
    calibration, aims = outputs.calibration, true.plan.spots
    frames = object_frames(calibration, true.calibration)
    at = np.array([aim.angle for aim in aims])
    turned = np.stack(frames)[at]
    hit = RayMesh.of(true.scan).first_hit(*true.calibration.spot_rays(aims))
    place = (true.scan.triangles[np.maximum(hit.triangle, 0)] * hit.barycentric[:, :, None]).sum(axis=1)
    origins, directions = calibration.spot_rays(aims)
    origins = np.einsum("sij,sj->si", turned[:, :3, :3], origins) + turned[:, :3, 3]
    directions = np.einsum("sij,sj->si", turned[:, :3, :3], directions)
    off = place - origins
    off -= (off * directions).sum(axis=1, keepdims=True) * directions
    return {"projector/aim mm": _rms([np.linalg.norm(off, axis=1)[hit.triangle >= 0]])}


def spot_figures(outputs: StageOutputs, true: TrueRun) -> dict[str, float]:
    """Root mean square over the spots that are used."""
    spots = outputs.spots
    used = (spots.transmitted > 0) & np.isfinite(true.hits[:, 0])
    return {"spots/place mm": _rms([np.linalg.norm(spots.position - true.hits, axis=1)[used]])}


def sample_figures(outputs: StageOutputs, true: TrueRun, footprint: sparse.csr_array | None = None) -> dict[str, float]:
    """By reciprocity light from a spot to a vertex is the true column of the vertex, at the spot's footprint.

    footprint: (S, V) `beam_footprints`, where they are known already
    """
    truth = true.truth
    footprint = beam_footprints(true.scan, outputs.spots) if footprint is None else footprint
    estimate = outputs.values[:, :, truth.columns].transpose(0, 2, 1)  # (L, n, S)
    mean = np.stack([(footprint @ column.T).T for column in truth.mean])
    error = np.stack([np.sqrt(footprint.power(2) @ (column**2).T).T for column in truth.standard_error])
    return _by_decade("samples", estimate, mean, error)


def completion_figures(outputs: StageOutputs, true: TrueRun) -> dict[str, float]:
    """Entries by decade; a column's total is the light that leaves anywhere per light that arrives over its vertex. The
    bias of totals counts with its standard error: one that happens to be next to nothing is no better than that.
    """
    truth, exitance = true.truth, outputs.exitance
    if exitance is None:
        return {}
    figures = _by_decade("completion", exitance, truth.mean, truth.standard_error)
    for name, chosen in {"lit": outputs.lit, "unlit": ~outputs.lit}.items():
        score = score_totals(exitance @ truth.area, truth, chosen)
        bias = [_with_error(x, error) for x, error in zip(score.mean, score.mean_se, strict=True)]
        spread = [math.inf if x is None else x for x in score.spread]
        figures[f"completion/{name} totals log10 bias"] = float(np.mean(bias))
        figures[f"completion/{name} totals spread"] = float(np.mean(spread))
    return figures


def _with_error(mean: float | None, error: float | None) -> float:
    """log10 of a mean ratio, grown by its standard error; its sign stays."""
    if mean is None or error is None or mean <= 0:
        return math.inf
    bias = math.log10(mean)
    return math.copysign(math.hypot(bias, error / mean / math.log(10)), bias)


def relit_figures(outputs: StageOutputs, true: TrueRun) -> dict[str, float]:
    """nrmse without the references' noise (`pipeline.relight.scores`), and how far the energy ratio is from 1."""
    figures = {}
    for (light, view), image in outputs.images.items():
        a, b = true.halves[light, view]
        score = usable_score(f"{light} {view}", np.asarray(image, np.float32), a, b, true.masks[view])
        nrmse, energy = score["nrmse"], score["energy_ratio"]
        figures[f"relit/{light}@{view} nrmse"] = math.inf if nrmse is None else nrmse
        figures[f"relit/{light}@{view} energy - 1"] = math.inf if energy is None else energy - 1
    return figures


def _by_decade(stage: str, estimate: F64, mean: F64, error: F64) -> dict[str, float]:
    """By decade of the truth, log10 rmse and log10 bias of the observed entries; the truth's noise is removed."""
    seen = np.isfinite(estimate)
    figures = {}
    for s in score_entries(np.where(seen, estimate, 0.0), mean, error, seen, DECADES):
        figures[f"{stage}/decade {s.decade} log10 rmse"] = math.inf if s.log10_rmse is None else s.log10_rmse
        figures[f"{stage}/decade {s.decade} log10 bias"] = math.inf if s.log10_bias is None else s.log10_bias
    return figures


FIGURES: dict[str, Callable[[StageOutputs, TrueRun], dict[str, float]]] = {
    "pose": pose_figures,
    "projector": projector_figures,
    "spots": spot_figures,
    "samples": sample_figures,
    "completion": completion_figures,
    "relit": relit_figures,
}


def all_figures(outputs: StageOutputs, true: TrueRun) -> dict[str, float]:
    """Every stage's figures by name; the part of a name before the slash is the stage."""
    return {name: value for figures in FIGURES.values() for name, value in figures(outputs, true).items()}


def _hits(experiment: Experiment, actual: ActualRig) -> F64:
    """(S, 3) mm, where the beams' axes met the object, mirror errors included; NaN where one missed."""
    mesh = experiment.object.mesh
    hit = RayMesh.of(mesh).first_hit(*actual.spot_rays(experiment.plan.spots))
    place = (mesh.triangles[np.maximum(hit.triangle, 0)] * hit.barycentric[:, :, None]).sum(axis=1)
    return np.where(hit.triangle[:, None] >= 0, place, np.nan)


def _rms(parts: list[F64]) -> float:
    return float(np.sqrt((np.concatenate([p.ravel() for p in parts]) ** 2).mean()))
