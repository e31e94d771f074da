"""Relit images against references, R_d against the truth, for every method of a run."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any, Literal

import numpy as np

from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.references import reference_path
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.light.references import LAYERS, load_reference
from disco_twin.light.truth import Truth
from hw.base.arrays import F32, Bool
from hw.base.config import Strict, read_json
from hw.base.errors import InputError
from hw.base.files import write_json
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.model.relightable import RelightableModel
from pipeline.relight.lights import Light
from pipeline.relight.scores import Unscorable, score_reflectance, score_relit

log = logging.getLogger(__name__)

FORMAT_VERSION = 1
KEPT = ("nrmse", "nrmse_se", "nrmse_floor", "psnr", "energy_ratio")


class _Scores(Strict):
    """scores.json."""

    format_version: Literal[1]
    relit: tuple[dict[str, float | str | None], ...]
    reflectance: dict[str, dict[str, dict[str, float | None]] | None]


def score_run(experiment: Experiment, folder: RunFolder, methods: Sequence[str]) -> None:
    """Write OUT/twin/scores.json: `relit` rows of every light, view and method, and `reflectance` by method."""
    scores = {
        "format_version": FORMAT_VERSION,
        "relit": score_relit_images(experiment, folder, methods),
        "reflectance": score_reflectances(folder, {m: partial(load_model, folder, m) for m in methods}),
    }
    write_json(folder.scores_file, scores)


def load_scores(folder: RunFolder) -> dict[str, Any]:
    """What `score_run` wrote."""
    remedy = f"delete it, then disco-twin score --out {folder.root}"
    return read_json(folder.scores_file, _Scores, remedy).model_dump()


def score_relit_images(experiment: Experiment, folder: RunFolder, methods: Sequence[str]) -> list[dict[str, Any]]:
    """`score_images` of what the pipeline left."""
    return score_images(experiment, folder, methods, lambda *which: load_relit(folder, *which))


def score_images(
    experiment: Experiment,
    folder: RunFolder,
    methods: Sequence[str],
    image_of: Callable[[str, str, CameraConfig], F32],
) -> list[dict[str, Any]]:
    """Rows {light, view, method, nrmse, nrmse_se, nrmse_floor, psnr, energy_ratio}; what has no score holds None.

    image_of: method, light, view -> (L, H, W) relit image in W/(mm^2 sr)
    """
    rows = []
    masks = {view.name: experiment.object_mask(view) for view in experiment.scene.relight.views}
    for light in experiment.scene.relight.lights:
        for view in experiment.scene.relight.views:
            a, b = reference_halves(folder, light, view)
            for method in methods:
                image = image_of(method, light.name, view)
                row = {"light": light.name, "view": view.name, "method": method}
                rows.append(row | usable_score(" ".join(row.values()), image, a, b, masks[view.name]))
    return rows


def usable_score(what: str, image: F32, a: F32, b: F32, mask: Bool) -> dict[str, float | None]:
    """The kept figures of `score_relit`; all None, with a warning, where they cannot be had or are not finite."""
    try:
        score = asdict(score_relit(image, a, b, mask))
        if not all(math.isfinite(score[k]) for k in KEPT if score[k] is not None):
            raise Unscorable("the relit image holds numbers that are not finite")
    except Unscorable as why:
        log.warning("no score for %s: %s", what, why)
        return dict.fromkeys(KEPT)
    return {k: score[k] for k in KEPT}


def reference_halves(folder: RunFolder, light: Light, view: CameraConfig) -> F32:
    """(2, L, H, W) both halves of a reference, W/(mm^2 sr): the light from below the surface, which R_d answers for."""
    return load_reference(reference_path(folder.twin / "references", light, view)).halves[:, LAYERS.index("subsurface")]


def load_relit(folder: RunFolder, method: str, light: str, view: CameraConfig) -> F32:
    """(L, H, W) relit image in W/(mm^2 sr)."""
    path = folder.work / "relit" / method / f"{light}@{view.name}.npy"
    if not path.is_file():
        raise InputError("is missing", file=path, remedy=f"disco-twin reconstruct --out {folder.root}")
    remedy = f"delete it, then disco-twin reconstruct --out {folder.root}"
    try:
        image = np.asarray(np.load(path, allow_pickle=False))
    except (OSError, ValueError, EOFError, SyntaxError) as error:
        raise InputError("is damaged", file=path, remedy=remedy) from error
    if image.ndim != 3 or image.shape[1:] != (view.height, view.width) or image.dtype.kind != "f":
        allowed = f"(lasers, {view.height}, {view.width})"
        raise InputError(f"is no image of this view but of {image.shape}", file=path, allowed=allowed, remedy=remedy)
    return image


def load_model(folder: RunFolder, method: str) -> RelightableModel:
    """A method's model. Raises: InputError where its file is missing, damaged or of another version."""
    return RelightableModel.load(folder.work / f"model-{method}.npz")


def score_reflectances(folder: RunFolder, models: Mapping[str, Callable[[], RelightableModel]]) -> dict[str, Any]:
    """By method, given how to get its model: log10_rmse of measured and of all entries, and the coverage, each by
    decade below the peak.

    A method whose R_d cannot be scored has None; one whose model states no R_d is left out.
    """
    truth = Truth.load(folder.twin / "truth.npz")
    out: dict[str, Any] = {}
    for method, model in models.items():
        estimate = model().reflectance_columns(truth.columns)
        if estimate is None:
            continue
        try:
            own = score_reflectance(estimate.mean, truth.mean, truth.standard_error, estimate.measured)
            full = score_reflectance(estimate.mean, truth.mean, truth.standard_error, True)
        except Unscorable as why:
            log.warning("no score for the R_d of %s: %s", method, why)
            out[method] = None
            continue
        out[method] = {
            "measured": {str(s.decade): s.log10_rmse for s in own},
            "completed": {str(s.decade): s.log10_rmse for s in full},
            "coverage": {str(s.decade): s.coverage for s in own},
        }
    return out
