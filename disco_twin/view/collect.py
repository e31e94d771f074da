"""What the page shows, read from a finished run's folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from disco_twin.evaluate.scores import load_model, load_relit, load_scores, reference_halves
from disco_twin.experiment.experiment import Experiment, mm_per_pixel
from disco_twin.experiment.pipeline_process import load_results
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.light.truth import Truth
from disco_twin.view.pack import Block, ordered_pairs
from hw.base.arrays import F32, F64
from hw.base.errors import InputError
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.model.factorise import Truncation, factorised
from pipeline.model.factorised import FactorisedTerm
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.model.term import Term
from pipeline.relight.lights import Environment, Light, Uniform
from pipeline.relight.on_mesh import LightOnMesh

FLOOR = 1e-12  # mm^-2: of what has a logarithm in the page


@dataclass(frozen=True)
class Page:
    """head: JSON; block: arrays; still: (H, W, 3) radiance of the picture where there is no WebGL2."""

    head: dict[str, Any]
    block: Block
    still: F32


def require_finished(folder: RunFolder) -> None:
    """Raises: InputError for a run without models or images to compare with."""
    for name in ("capture", "truth", "references", "pipeline", "scores"):
        if name not in folder.stages or not folder.stages[name].finished:
            again = f"disco-twin run {folder.scene_file} --out {folder.root}"
            raise InputError(f"the run is unfinished: the stage {name} is not done", file=folder.root, remedy=again)


def bytes_of(model: RelightableModel, cut: Truncation) -> int:
    """About how many bytes the page's factors have, before base64; the rest is small beside them."""
    vertices = len(model.mesh.vertices)
    pairs, modes = vertices * min(cut.near, vertices) // 2, cut.rank * -(-vertices // cut.patch)
    return 2 * (model.lasers * (pairs + modes**2 // 2 + vertices * cut.rank) + pairs)


def collect(folder: RunFolder, method: str | None, chosen: Callable[[RelightableModel], Truncation]) -> Page:
    """Read a run and factorise its model. chosen: how far; raises for a model that is too large for a page.

    Raises: InputError where something is missing, damaged or unfinished, and what `chosen` raises.
    """
    require_finished(folder)
    scene, made, scores = folder.read_scene(), load_results(folder), load_scores(folder)
    if method is not None and method not in made.methods:
        remedy = f"disco-twin reconstruct --out {folder.root} --methods {method}, then score"
        raise InputError(
            "was not reconstructed here", key="--method", value=method, allowed=", ".join(made.methods), remedy=remedy
        )
    method = method or next(iter(made.methods))
    experiment, exact = Experiment(scene), load_model(folder, method)
    if exact.lasers > 3:
        remedy = "choose three lasers in the scene, and run it again"
        raise InputError(
            "too many to show", file=folder.root, key="lasers", value=exact.lasers, allowed="1 to 3", remedy=remedy
        )
    cut = chosen(exact)
    block, numbers = model_block(exact, factorised(exact, cut), scene.relight.lights)
    lights, views = scene.relight.lights, scene.relight.views
    truth = _add_curves(block, exact, Truth.load(folder.twin / "truth.npz"))
    for i, light in enumerate(lights):
        for k, view in enumerate(views):
            mask = experiment.object_pixels(view).mask
            image = reference_halves(folder, light, view).mean(axis=0) * mask
            block.half(f"reference{i}.{k}", _rounded(image))
    errors = {f"{r['light']}@{r['view']}": r["nrmse"] for r in scores["relit"] if r["method"] == method}
    head = numbers | {
        "scene": scene.name,
        "seed": scene.seed,
        "method": method,
        "wavelengths_nm": [laser.wavelength_nm for laser in scene.rig.lasers],
        "views": [_camera(v) for v in views],
        "errors": errors,
        "curves": truth,
        "kept": asdict(cut),
        "provenance": [f"disco-twin {version('disco-twin')}", *(f"{k}: {v}" for k, v in exact.provenance.items())],
    }
    still = load_relit(folder, method, lights[0].name, views[0])
    return Page(head, block, still)


def model_block(
    exact: RelightableModel, fast: RelightableModel, lights: Sequence[Light]
) -> tuple[Block, dict[str, Any]]:
    """What the page computes with: mesh, factors and lights; and what the head states of them."""
    block = Block()
    _add_mesh(block, exact)
    terms = [
        _add_term(block, n, term, own)
        for n, (term, own) in enumerate(zip(fast.terms, exact.terms, strict=True))
        if isinstance(term, FactorisedTerm)
    ]
    return block, {
        "lasers": exact.lasers,
        "vertices": len(exact.mesh.vertices),
        "boundary": asdict(exact.boundary),
        "mean_transmittance": exact.boundary.mean_transmittance,
        "terms": terms,
        "lights": [_add_light(block, light, exact, fast) for light in lights],
    }


def _add_mesh(block: Block, model: RelightableModel) -> None:
    wide = "u2" if len(model.mesh.vertices) <= 1 << 16 else "u4"
    block.add("points", model.mesh.vertices, "f4")
    block.add("faces", RayMesh.of(model.mesh).faces, wide)
    block.add("normals", model.mesh.vertex_normals, "f4")


def _add_term(block: Block, n: int, term: FactorisedTerm, exact: Term) -> dict[str, Any]:
    """The arrays of a term; what the head states of it. The kernel for directions follows from the slopes."""
    count, modes, laws = len(term.patch), term.coupling.shape[1], {}
    counts, second, order = ordered_pairs(term.pair, count)
    wide = "u2" if count <= 1 << 16 else "u4"
    block.add(f"term{n}.pair_counts", counts, "u2")
    block.add(f"term{n}.pair_second", second, wide)
    block.add(f"term{n}.patch", term.patch, "u2")
    block.half(f"term{n}.near", term.near[:, order])
    block.half(f"term{n}.basis", term.basis)
    # Of single columns each to its own size, or a dark patch's coupling would be rounded to a bright one's.
    scale = np.maximum(np.abs(term.coupling).max(axis=2, initial=0.0), 1e-30).astype(np.float64)
    block.add(f"term{n}.coupling_scale", scale, "f4")
    upper = np.triu_indices(modes)
    block.half(f"term{n}.coupling", (term.coupling / np.sqrt(scale[:, :, None] * scale[:, None]))[:, *upper])
    if isinstance(exact, GlobalTerm) and exact.tilt is not None and exact.tilt_distance is not None:
        laws = {"slope": exact.tilt.tolist(), "distance": exact.tilt_distance.tolist()}
    return {"rank": term.basis.shape[2], "modes": modes, "tilt": laws or None}


def _add_light(block: Block, light: Light, model: RelightableModel, fast: RelightableModel) -> dict[str, Any]:
    """A shipped light; of one from many directions the flux itself, which takes the page too many rays. `off`: the most
    that the factors make of its radiosity's error, relative.
    """
    lit = LightOnMesh(light, model.mesh, model.boundary, model.lasers)
    area, stored = RayMesh.of(model.mesh).vertex_areas, None
    if isinstance(light, Uniform | Environment):
        stored = light.name
        block.half(f"flux{stored}", np.moveaxis(lit.tilted_flux, 0, -1))
    points, rms, bound = np.asarray(model.mesh.vertices, np.float64), 0.0, 0.0
    for term in fast.terms:
        assert isinstance(term, FactorisedTerm)
        flux = lit.tilted_flux if term.by_direction else lit.flux[None]
        rms += float(np.sqrt((term.radiosity(flux, points)[0] ** 2 @ area).sum() / area.sum()))
        bound += float(np.linalg.norm(term.error_bound(flux, area)[0]))
    return light.model_dump() | {"stored": stored, "off": bound / rms if rms > 0 else 0.0}


def _add_curves(block: Block, model: RelightableModel, truth: Truth) -> dict[str, Any]:
    """Logarithms of exitance per irradiance: the truth's columns, with the model's own."""
    own = model.exitance_columns(truth.columns)
    block.add("truth_vertices", truth.columns, "u4")
    block.half("truth_log", np.log(np.maximum(truth.mean, FLOOR)))
    if own is not None:
        block.half("column_log", np.log(np.maximum(own.mean, FLOOR)))
    return {"model": own is not None}


def _camera(view: CameraConfig) -> dict[str, Any]:
    camera = PinholeCamera.from_config(view)
    return {
        "name": view.name, "width": camera.width, "height": camera.height, "focal": camera.focal.tolist(),
        "centre": camera.centre.tolist(), "pose": camera.pose.tolist(), "mm_per_pixel": mm_per_pixel(view),
    }  # fmt: skip


def _rounded(image: F32 | F64) -> F32:
    """Images to half a percent, less than their noise: what is rounded away need not be stored."""
    mantissa, exponent = np.frexp(np.asarray(image, np.float64))
    return np.asarray(np.ldexp(np.round(mantissa * 256) / 256, exponent), np.float32)
