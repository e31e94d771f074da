"""Relit images against references, columns of exitance against the truth, for every method of a run."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from disco_twin.evaluate.columns import score_columns
from disco_twin.evaluate.z_scores import ZScores, z_of_pixels
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.references import load_outside_reference, read_reference, reference_path
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.light.references import LAYERS
from hw.base.arrays import F32, F64, Bool
from hw.base.config import Strict, read_json
from hw.base.errors import InputError
from hw.base.files import write_json
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.model.relightable import RelightableModel
from pipeline.relight.lights import Light
from pipeline.relight.scores import Unscorable, score_relit

log = logging.getLogger(__name__)

FORMAT_VERSION = 3
KEPT = ("nrmse", "nrmse_se", "nrmse_floor", "psnr", "energy_ratio")
RIM = ("nrmse", "nrmse_se")
OUTSIDE = ("nrmse", "nrmse_se")  # against the outside reference, kept as volpath_nrmse, volpath_nrmse_se


class _Scores(Strict):
    """scores.json."""

    format_version: Literal[3]
    relit: tuple[dict[str, float | str | None], ...]
    reflectance: dict[str, dict[str, dict[str, float | None]] | None]
    totals: dict[str, dict[str, dict[str, Any]]]
    slopes: dict[str, dict[str, Any]]
    neck: dict[str, dict[str, Any]] | None
    z: dict[str, dict[str, Any]]


def score_run(experiment: Experiment, folder: RunFolder, methods: Sequence[str]) -> None:
    """Write OUT/twin/scores.json: `relit` rows of every light, view and method, and what `score_columns` makes."""
    relit = score_relit_images(experiment, folder, methods)
    columns = score_columns(experiment, folder, {m: partial(load_model, folder, m) for m in methods})
    for method, z in columns["z"].items():
        if not any((folder.work / "relit-variance" / method).glob("*.npy")):
            continue  # the model states one for its entries alone
        image, variance = partial(load_relit, folder, method), partial(load_variance, folder, method)
        z["pixels"] = z_of_images(experiment, folder, image, variance)
    write_json(folder.scores_file, {"format_version": FORMAT_VERSION, "relit": relit} | columns)


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
    """Rows {light, view, method, nrmse, nrmse_se, nrmse_floor, psnr, energy_ratio, rim_nrmse, rim_nrmse_se}; what has
    no score holds None. The rim's figures are of the object's pixels at its rim, all others of those without it. Where
    a light and view has an outside reference, its rows have volpath_nrmse and volpath_nrmse_se, against that one.

    image_of: method, light, view -> (L, H, W) relit image in W/(mm^2 sr)
    """
    rows = []
    for light in experiment.scene.relight.lights:
        for view in experiment.scene.relight.views:
            a, b = reference_halves(folder, light, view)
            outside = outside_halves(experiment, folder, light, view)
            pixels = experiment.object_pixels(view)
            for method in methods:
                image = image_of(method, light.name, view)
                what = f"{light.name} {view.name} {method}"
                row: dict[str, Any] = {"light": light.name, "view": view.name, "method": method}
                inner = usable_score(what, image, a, b, pixels.inner)
                rim = usable_score(f"the rim of {what}", image, a, b, pixels.rim) if pixels.rim.any() else {}
                row |= inner | {f"rim_{key}": rim.get(key) for key in RIM}
                if outside is not None:
                    other = usable_score(f"{what} against volpath", image, outside[0], outside[1], pixels.inner)
                    row |= {f"volpath_{key}": other[key] for key in OUTSIDE}
                rows.append(row)
    return rows


def z_of_images(
    experiment: Experiment,
    folder: RunFolder,
    image_of: Callable[[str, CameraConfig], F32],
    variance_of: Callable[[str, CameraConfig], F32],
) -> dict[str, Any]:
    """By light, `ZScores` of the pixels of all views together without their rims, the errors of the model's entries
    taken as `independent` and as `alike`.

    image_of, variance_of: light, view -> (L, H, W) relit image, and its variance (`RelightableModel.image_variance`)
    """
    out: dict[str, Any] = {}
    for light in experiment.scene.relight.lights:
        parts: dict[str, list[F64]] = {"independent": [], "alike": []}
        for view in experiment.scene.relight.views:
            halves, inner = reference_halves(folder, light, view), experiment.object_pixels(view).inner
            image = image_of(light.name, view)
            for z, variance in zip(parts.values(), variance_of(light.name, view), strict=True):
                z.append(z_of_pixels(image, variance, halves, inner))
        out[light.name] = {name: asdict(ZScores.of(np.concatenate(z, axis=None))) for name, z in parts.items()}
    return out


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
    return read_reference(reference_path(folder.twin / "references", light, view)).halves[:, LAYERS.index("subsurface")]


def outside_halves(experiment: Experiment, folder: RunFolder, light: Light, view: CameraConfig) -> F32 | None:
    """The same of the outside reference, if the scene has one of this light and view."""
    found = load_outside_reference(folder.twin / "references", experiment.scene, light, view)
    return None if found is None else found.halves[:, LAYERS.index("subsurface")]


def load_relit(folder: RunFolder, method: str, light: str, view: CameraConfig) -> F32:
    """(L, H, W) relit image in W/(mm^2 sr). Raises: InputError where it is missing or damaged."""
    return _load_image(folder, folder.work / "relit" / method / f"{light}@{view.name}.npy", 3, view)


def load_variance(folder: RunFolder, method: str, light: str, view: CameraConfig) -> F32:
    """(2, L, H, W) variance of a relit image (`RelightableModel.image_variance`). Raises: as `load_relit`."""
    return _load_image(folder, folder.work / "relit-variance" / method / f"{light}@{view.name}.npy", 4, view)


def _load_image(folder: RunFolder, path: Path, axes: int, view: CameraConfig) -> F32:
    if not path.is_file():
        raise InputError("is missing", file=path, remedy=f"disco-twin reconstruct --out {folder.root}")
    remedy = f"delete it, then disco-twin reconstruct --out {folder.root}"
    try:
        image = np.asarray(np.load(path, allow_pickle=False))
    except (OSError, ValueError, EOFError, SyntaxError) as error:
        raise InputError("is damaged", file=path, remedy=remedy) from error
    if image.ndim != axes or image.shape[-2:] != (view.height, view.width) or image.dtype.kind != "f":
        allowed = f"({'2, ' * (axes - 3)}lasers, {view.height}, {view.width})"
        raise InputError(f"is no image of this view but of {image.shape}", file=path, allowed=allowed, remedy=remedy)
    return image


def load_model(folder: RunFolder, method: str) -> RelightableModel:
    """A method's model. Raises: InputError where its file is missing, damaged or of another version."""
    return RelightableModel.load(folder.work / f"model-{method}.npz")
