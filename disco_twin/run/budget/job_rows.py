"""Rows of the method and of the whole job: the pipeline given exact samples, scan, calibration, or a quiet camera.

The truth goes to the pipeline here on purpose, into folders of the twin's own, and into no score of the run.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from disco_twin.camera.lars3 import Lars3
from disco_twin.emulation.twin_rig import TwinCamera
from disco_twin.evaluate.exact_light import ExactLight
from disco_twin.evaluate.scores import load_relit
from disco_twin.evaluate.true_calibration import VARIANTS, true_calibration
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.pipeline_process import reconstruct_apart
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.faults.actual_rig import actual_rig
from disco_twin.run.budget.rows import EXACT_SAMPLES, EXACT_SCAN, MEASURED, NOMINAL, QUIET, Images
from disco_twin.run.simulate import twin_rig
from disco_twin.run.stages import Run
from hw.base.arrays import F32, F64
from hw.record import RawImage
from pipeline.calibrate.calibration import Calibration, nominal_calibration
from pipeline.capture.loop import capture
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import Boundary
from pipeline.reconstruct.methods import reconstruct
from pipeline.reconstruct.samples.samples_file import load_samples
from pipeline.relight.on_mesh import LightOnMesh, ViewOfMesh

DISTANCES = 40  # bins over which the noise of exact samples is pooled


class JobRows:
    """What one method of a run relights in its held-out views. place: the folder for what is made anew.

    All rows raise InputError where a file of the run is missing or damaged, PipelineFailed where the pipeline fails.
    """

    def __init__(self, run: Run, method: str, place: Path) -> None:
        self.run, self.method, self.place = run, method, place
        self.lights, self.views = run.scene.relight.lights, run.scene.relight.views

    def measured(self) -> dict[str, Images]:
        """What the run has left."""
        return {MEASURED: self.relit(self.run.folder)}

    def exact_samples(self, exact: ExactLight, curve: Boundary) -> dict[str, Images]:
        """Its samples replaced by the object's own R_d between the beams and the hat functions, where it has some.

        Light enters diffusely over the beams' footprints, so that nothing but completion is left to err. Relit as the
        rows of light are: with the floor's curve at the exit, and the smooth F_t at the entry.
        """
        own = load_samples(self.run.folder.work / "samples.npz")
        value, variance = exact.spot_responses(own.spots)
        samples = replace(
            own,
            values=np.where(np.isfinite(own.values), value, np.nan).astype(np.float32),
            dark_variance=np.zeros_like(own.dark_variance),
            noise_per_signal=noise_per_signal(value, variance, own.spot_pairs.distance).astype(np.float32),
            oblique=np.zeros_like(own.oblique),
            tilt=np.zeros_like(own.tilt),
            lobe=None,
            glow=(),
        )
        model, smooth = reconstruct(samples, self.method), Boundary(own.eta)
        lit = {x.name: LightOnMesh(x, model.mesh, smooth, model.lasers) for x in self.lights}
        out: dict[tuple[str, str], NDArray[np.floating]] = {}
        for view in self.views:
            seen = ViewOfMesh(PinholeCamera.from_config(view), model.mesh, curve)
            for name, light in lit.items():
                out[name, view.name] = _twice(np.sum([term.image(light, seen) for term in model.terms], axis=0))
        return {EXACT_SAMPLES: out}

    def recalibrated(self, own: Calibration, name: str) -> dict[str, Images]:
        """The job with another calibration: the nominal one, or a part of the measured one made true (`VARIANTS`)."""
        scene = self.run.scene
        nominal = nominal_calibration(scene.rig, own.sensor)
        true = true_calibration(scene.rig, actual_rig(scene.rig, scene.seed), nominal)
        variant = self.variant(name)
        given = variant.root / "calibration.json"
        (nominal if name == NOMINAL else VARIANTS[name](own, true)).save(given)
        return self.again(name, variant, given)

    def exact_scan(self) -> dict[str, Images]:
        """The job on the same images with a scan that has no error, calibrated anew from them."""
        rig = self.run.scene.rig
        faultless = rig.model_copy(update={"faults": rig.faults.model_copy(update={"scanner": False})})
        scan = Experiment(self.run.scene.model_copy(update={"rig": faultless})).scan
        variant = self.variant(EXACT_SCAN, linked=lambda path: path.name != "scan.ply")
        (variant.capture / "scan.ply").write_bytes(bytes(scan.export(file_type="ply")))
        return self.again(EXACT_SCAN, variant)

    def quiet_camera(self) -> dict[str, Images]:
        """The job on images of the same light by cameras whose photons and electronics do not fluctuate."""
        kept = {"scan.ply", "rig.json", "sensor.json", "calibration"}
        variant = self.variant(QUIET, linked=lambda path: path.name in kept)
        rig = twin_rig(self.run.experiment, self.run.folder.twin / "responses")
        for camera in rig.cameras:
            assert isinstance(camera, TwinCamera)
            camera.optics = QuietCamera(**vars(camera.optics))
        capture(rig, self.run.experiment.plan, variant.capture)
        return self.again(QUIET, variant)

    def again(self, row: str, variant: RunFolder, calibration: Path | None = None) -> dict[str, Images]:
        """The row of a folder in which the pipeline does its work again; removed afterwards."""
        reconstruct_apart(self.run.scene, variant, (self.method,), calibration)
        images = self.relit(variant)
        shutil.rmtree(variant.root)
        return {row: images}

    def relit(self, folder: RunFolder) -> Images:
        """What the pipeline left in a folder."""
        return {
            (light.name, view.name): _twice(load_relit(folder, self.method, light.name, view))
            for light in self.lights
            for view in self.views
        }

    def variant(self, name: str, linked: Callable[[Path], bool] | None = None) -> RunFolder:
        """A folder to reconstruct in, begun anew; with `linked`, one whose capture holds links to those files only."""
        root = self.place / name.replace(" ", "-")
        shutil.rmtree(root, ignore_errors=True)
        folder = self.run.folder.variant(root)
        folder.work.mkdir(parents=True)
        if linked is not None:
            folder.capture = root / "capture"
            folder.capture.mkdir()
            for path in filter(linked, self.run.folder.capture.iterdir()):
                (folder.capture / path.name).symlink_to(path.resolve())
        return folder


def noise_per_signal(value: F64, variance: F64, distance: F64) -> F64:
    """(L, S, V) variance per signal in mm^-2 of samples by photons, the mean over all that lie as far from their spots.

    Of a few replicates, those that come out low have a low variance, too: weighed by their own, all would be too dark.

    value, variance: (L, S, V) mm^-2 and mm^-4; distance: (S, V) mm
    """
    edges = np.quantile(distance, np.linspace(0.0, 1.0, DISTANCES + 1)[1:-1])
    group = np.searchsorted(edges, distance)
    sums = (np.stack([np.bincount(group.ravel(), x.ravel(), DISTANCES) for x in a]) for a in (variance, value))
    noise, light = sums
    return np.asarray(np.divide(noise, light, out=np.zeros_like(light), where=light > 0)[:, group])


class QuietCamera(Lars3):
    """The camera whose photons and electronics do not fluctuate; a dither of one digital number keeps means right."""

    def expose(self, radiance: F32, laser: int, rng: Any, exponent: int | None = None) -> RawImage:
        """As `Lars3.expose`."""
        dither = self.sensor.gain_e_per_dn / max(self.sensor.read_noise_e, 1e-9)
        return super().expose(radiance, laser, Expectation(rng, dither), exponent)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Expectation:
    """Stands for a generator. dither: width of a uniform number in place of the normal one of the read-out."""

    rng: Generator
    dither: float

    def poisson(self, mean: F64) -> F64:
        """The mean itself."""
        return mean

    def standard_normal(self, shape: Sequence[int]) -> F64:
        """Uniform, of the dither's width."""
        return self.dither * self.rng.uniform(-0.5, 0.5, shape)


def _twice(image: F32) -> NDArray[np.floating]:
    """An image without noise of its own, as both halves."""
    return np.stack([image, image])
