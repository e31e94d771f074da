"""A run folder in which all but the scores is finished, made from a known R_d without a renderer."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from reconstruct_capture import RADIUS, reflectance, rig, write_capture

from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.keys import identity
from disco_twin.experiment.pipeline_process import pipeline_inputs
from disco_twin.experiment.references import reference_path
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.light.balance import EnergyBalance
from disco_twin.light.moments import Moments
from disco_twin.light.references import Reference, save_reference
from disco_twin.light.truth import Truth
from disco_twin.scene.scene import Scene
from hw.base.config import read_json
from hw.base.files import write_json
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.mesh import RayMesh
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.reconstruct.samples.distances import vertex_pairs
from pipeline.run import Request, run

NOISE = 0.02  # of either half of a reference, relative
VIEWS = ({"name": "left", "width": 48, "height": 40}, {"name": "right", "width": 64, "height": 40})


def frozen_scene() -> Scene:
    """A sphere under two lights, in two views of different size."""
    common = {"focal_length_mm": 20.0, "pixel_pitch_um": 40.0}
    places = ((380.0, 0.0, 60.0), (0.0, 380.0, 60.0))
    medium = {"base": {"kind": "homogeneous", "sigma_t_per_mm": 1.0, "albedo": 0.9}}
    return Scene.model_validate(
        {
            "format_version": 1,
            "name": "frozen",
            "object": {"shape": {"kind": "sphere", "radius_mm": RADIUS}, "medium": medium},
            "scan": {"vertices": 80},
            "rig": rig().model_dump(),
            "simulation": {"truth_columns": 8},
            "reconstruct": {"methods": ["dipole"]},
            "relight": {
                "views": [common | view | {"position_mm": p} for view, p in zip(VIEWS, places, strict=True)],
                "lights": [
                    {"kind": "uniform", "colour": [1.0, 1.0]},
                    {"kind": "directional", "direction": [-1.0, -1.0, 0.0], "colour": [1.0, 1.0]},
                ],
            },
        }
    )


def write_frozen_run(root: Path) -> np.ndarray:
    """Make the folder; the true R_d (L, V, V) in mm^-2."""
    made, exact = _made()
    shutil.copytree(made, root)
    shutil.copy(made.with_suffix(".toml"), root.with_suffix(".toml"))
    return exact.copy()


@cache
def _made() -> tuple[Path, np.ndarray]:
    """A folder that the others are copies of, which lasts as long as the tests do; it takes five seconds."""
    folder = Path(tempfile.mkdtemp(prefix="frozen-run-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder / "out", _make(folder / "out")


def _make(root: Path) -> np.ndarray:
    scene = frozen_scene()
    experiment, text = Experiment(scene), root.with_suffix(".toml")
    text.write_text("# frozen\n")
    folder = RunFolder.claim(root, text, identity(scene))
    folder.scene_record.write_text(scene.model_dump_json())
    folder.capture.rmdir()
    write_capture(folder.capture, scan=experiment.scan)
    pairs, columns = vertex_pairs(experiment.scan), np.arange(0, 64, 8)
    exact = np.stack([pairs.mean(lambda d, k=k: reflectance(d, k)) for k in range(2)])
    exact = 0.5 * (exact + exact.transpose(0, 2, 1))
    balance = EnergyBalance(**{name: np.ones(2) for name in EnergyBalance.__dataclass_fields__})
    term = GlobalTerm(exact.astype(np.float32), np.ones(exact.shape[1:], bool))
    model, noise = RelightableModel(experiment.scan, Boundary(1.3), (term,)), np.random.default_rng(1)
    entries = model.exitance_columns(columns)
    replicates = (entries.mean * (1 + 0.03 * noise.standard_normal((8, *entries.mean.shape)))).astype(np.float32)
    Truth(columns, replicates, RayMesh.of(experiment.scan).vertex_areas, balance).save(folder.twin / "truth.npz")
    frames = np.broadcast_to(np.eye(3), (len(columns), 3, 3))
    plain = replicates[:, 0]
    along = np.zeros((8, 2, *plain.shape[1:]), np.float32)
    Moments(np.asarray(0), columns, frames[:, :2], frames, plain, along).save(folder.twin / "moments.npz")
    for light in scene.relight.lights:
        for view in scene.relight.views:
            image = model.image(model.lit_by(light), model.seen_by(PinholeCamera.from_config(view)))
            halves = image * (1 + NOISE * noise.standard_normal((2, 1, *image.shape)))
            layers = np.concatenate([halves, 0 * halves], axis=1).astype(np.float32)
            save_reference(reference_path(folder.twin / "references", light, view), Reference(layers, 0.03, "known"))
    write_json(folder.work / "request.json", pipeline_inputs(scene, ("lambertian",)))
    run(folder.capture, folder.work, read_json(folder.work / "request.json", Request, ""))
    for name in ("capture", "truth", "references", "pipeline"):
        folder.run(name, "frozen", lambda: None)
    return exact
