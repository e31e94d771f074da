"""`disco-twin budget OUT`: where a run's relighting error comes from, each part of the way made exact in turn.

Three kinds of rows. *Light*: photons between ends that are exact, diffuse or averaged over the scan's hat functions
(`evaluate.exact_light`); no pipeline. *Samples*: the method given exact R_d at the spots. *Job*: the whole pipeline on
the same capture, with the scan, parts of the calibration or the camera made exact. The truth goes to the pipeline here
on purpose, into folders of the twin's own, and into no score of the run.

Errors of parts interact, so what the rows cost need not add up in quadrature to the whole.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from disco_twin.camera.lars3 import Lars3
from disco_twin.emulation.twin_rig import TwinCamera
from disco_twin.evaluate.exact_light import ExactLight, SeenRadiosity, best_curve
from disco_twin.evaluate.scores import load_relit, reference_halves
from disco_twin.evaluate.summary import rms
from disco_twin.evaluate.true_calibration import VARIANTS, true_calibration
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.keys import content_key
from disco_twin.experiment.pipeline_process import reconstruct_apart
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.faults.actual_rig import actual_rig
from disco_twin.run.progress import stage_bar
from disco_twin.run.simulate import twin_rig
from disco_twin.run.stages import Run
from hw.base.arrays import F32, F64
from hw.base.config import Strict, read_json
from hw.base.errors import InputError
from hw.base.files import write_json
from hw.record import RawImage
from pipeline.calibrate.calibration import Calibration, nominal_calibration
from pipeline.capture.loop import Interrupted, capture
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import Boundary
from pipeline.reconstruct.methods import reconstruct
from pipeline.reconstruct.samples.samples_file import load_samples
from pipeline.relight.on_mesh import LightOnMesh, ViewOfMesh
from pipeline.relight.scores import Unscorable, score_halves, signed_root

FORMAT_VERSION = 2
RECORD = "budget.json"
WALKS = 4_000_000  # of a light, both halves together

# Rows of light, in the order of the way; the names are what the table shows.
EXACT_ENTRY = "exact entry, diffuse exit"
EXACT_EXIT = "diffuse entry, exact exit"
SMOOTH = "diffuse ends, smooth F_t"
FLOOR = "diffuse ends, best curve"
LUMPED = "exact entry, scan's hats (lumped)"
CONSISTENT = "exact entry, scan's hats (consistent)"
TRUE_MODEL = "true R_d on the scan's hats"
EXACT_SAMPLES = "exact samples, completed"
EXACT_SCAN, QUIET, MEASURED, NOMINAL = "scan without its error", "camera without noise", "as measured", "uncalibrated"
ALL_TRUE = "all true"

# What a part costs: the difference of the squares of two rows.
COSTS = {
    "eq. 2.1 (diffuse ends)": (FLOOR, None),
    "the scan's hats": (TRUE_MODEL, FLOOR),
    "completion": (EXACT_SAMPLES, TRUE_MODEL),
    "the scanner": (MEASURED, EXACT_SCAN),
    "calibration": (MEASURED, ALL_TRUE),
    "camera noise": (MEASURED, QUIET),
}
LEFT = "what is left"

Images = Mapping[tuple[str, str], NDArray[np.floating]]  # (light, view) -> (2, L, H, W) halves, W/(mm^2 sr)


class BudgetRow(Strict):
    """One row of the budget under one light in one view."""

    row: str
    light: str
    view: str
    nrmse: float | None
    nrmse_se: float | None


class _Group(Strict):
    """Rows that are made together, and the key of all that they depend on."""

    key: str
    rows: tuple[BudgetRow, ...]


class _Record(Strict):
    """OUT/twin/budget.json."""

    format_version: Literal[2]
    groups: dict[str, _Group]
    left_out: dict[str, str]


@dataclass(frozen=True)
class Budget:
    """rows: of everything that was made exact; left_out: what this run has no row for, and why."""

    rows: tuple[BudgetRow, ...]
    left_out: Mapping[str, str]

    def nrmse(self, row: str, light: str) -> float | None:
        """Views together; None where there is no score."""
        kept = [r.nrmse for r in self.rows if (r.row, r.light) == (row, light) and r.nrmse is not None]
        return rms(kept) if kept else None

    def cost(self, part: str, light: str) -> float | None:
        """Signed root of the difference of two rows' squares; of `LEFT`, what the parts leave of the whole."""
        if part == LEFT:
            whole, parts = self.nrmse(MEASURED, light), [self.cost(p, light) for p in COSTS]
            if whole is None:
                return None
            return signed_root(whole * abs(whole) - sum(p * abs(p) for p in parts if p is not None))
        more, less = (None if row is None else self.nrmse(row, light) for row in COSTS[part])
        if more is None or (less is None and COSTS[part][1] is not None):
            return None
        return signed_root(more * abs(more) - (0.0 if less is None else less * abs(less)))


def make_budget(run: Run, walks: int = WALKS) -> Budget:
    """All rows of a finished run; what is there under the same key is not made again. Needs the renderer.

    Raises: InputError where a stage of the run is not finished, Interrupted at Ctrl-C.
    """
    done = run.folder.stages
    for name in ("references", "pipeline"):
        if name not in done or not done[name].finished:
            remedy = f"disco-twin run {run.scene_file} --out {run.folder.root}"
            raise InputError(f"the stage {name} is not finished", file=run.folder.root, remedy=remedy)
    groups, left_out = _Groups(run, walks).wanted()
    path, kept = run.folder.twin / RECORD, {}
    if path.is_file():
        kept = dict(read_json(path, _Record, "delete it, then repeat the command").groups)
    keys = {name: run.key("budget", done["references"].key, *inputs) for name, (inputs, _) in groups.items()}
    try:
        with stage_bar(run.console, "budget", "parts") as report:
            for number, (name, (_, work)) in enumerate(groups.items()):
                report(number, len(groups))
                if name not in kept or kept[name].key != keys[name]:
                    kept[name] = _Group(key=keys[name], rows=_scored(run, work()))
                    record = {"format_version": FORMAT_VERSION, "left_out": left_out}
                    write_json(path, record | {"groups": {k: g.model_dump() for k, g in kept.items()}})
            report(len(groups), len(groups))
    except KeyboardInterrupt:
        raise Interrupted("stopped during budget; the same command continues") from None
    return Budget(tuple(row for name in groups for row in kept[name].rows), left_out)


def _scored(run: Run, rows: Mapping[str, Images]) -> tuple[BudgetRow, ...]:
    """Every image of these rows against its reference, without the object's rim."""
    out, relight = [], run.scene.relight
    masks = {view.name: run.experiment.object_pixels(view).inner for view in relight.views}
    for light in relight.lights:
        for view in relight.views:
            halves = reference_halves(run.folder, light, view)
            for row, images in rows.items():
                try:
                    score = score_halves(images[light.name, view.name], halves, masks[view.name])
                    figures: dict[str, float | None] = {"nrmse": score.nrmse, "nrmse_se": score.nrmse_se}
                except Unscorable:
                    figures = {"nrmse": None, "nrmse_se": None}
                out.append(BudgetRow(row=row, light=light.name, view=view.name, **figures))
    return tuple(out)


class _Groups:
    """What can be made exact in a run: by group, what its rows depend on, and how they are made."""

    def __init__(self, run: Run, walks: int) -> None:
        self.run, self.walks, self.method = run, walks, run.methods[0]
        self.experiment, self.folder = run.experiment, run.folder
        self.views = run.scene.relight.views
        self.cameras = [PinholeCamera.from_config(view) for view in self.views]
        self.place = run.folder.twin / "budget"

    def wanted(self) -> tuple[dict[str, tuple[list[Any], Callable[[], dict[str, Images]]]], dict[str, str]]:
        """(groups, what is left out and why)."""
        job = [self.folder.stages["pipeline"].key, self.method]
        light: list[Any] = [self.walks, self.eta, self.scene_part("object"), self.scene_part("relight")]
        groups: dict[str, tuple[list[Any], Callable[[], dict[str, Images]]]] = {
            "entry": (light, self.exact_entry),
            "ends": (light, self.diffuse_ends),
            "hats": (light, self.true_model),
            "samples": ([*light, *job], self.exact_samples),
            "measured": (job, lambda: {MEASURED: self.relit(self.folder)}),
        }
        left_out: dict[str, str] = {}
        own = Calibration.load(self.folder.work / "calibration.json")
        if own.source == "measured":
            names = [NOMINAL, *VARIANTS]
            groups |= {name: (job, lambda name=name: {name: self.recalibrated(own, name)}) for name in names}  # type: ignore[misc]
        else:
            left_out["calibration"] = "it was not measured: there is nothing to make true"
        if self.folder.taken_by_devices:
            left_out |= dict.fromkeys(["the scanner", "camera noise"], "devices took these images")
            return groups, left_out
        if self.run.scene.rig.faults.scanner:
            groups[EXACT_SCAN] = (job, lambda: {EXACT_SCAN: self.exact_scan()})
        else:
            left_out["the scanner"] = "it has no error here (rig.faults.scanner)"
        groups[QUIET] = (job, lambda: {QUIET: self.quiet_camera()})
        return groups, left_out

    def scene_part(self, name: str) -> str:
        """Key of a part of the scene."""
        return content_key(getattr(self.run.scene, name).model_dump())

    @property
    def eta(self) -> float:
        """The index that the pipeline assumes."""
        return self.run.scene.reconstruct.eta

    @cached_property
    def exact(self) -> ExactLight:
        """The object's light."""
        return ExactLight(self.experiment, self.eta, self.walks)

    # ---- rows of light

    def exact_entry(self) -> dict[str, Images]:
        """Light enters as it does, and leaves diffusely: on the fine mesh, and averaged over the scan's hats."""
        exact, lights = self.exact, self.run.scene.relight.lights
        power = {light.name: exact.power_of(light) for light in lights}
        fine = {name: exact.radiosity(p) for name, p in power.items()}
        curve = self.curve(fine)
        rows = {EXACT_ENTRY: self.images(exact.mesh, curve, fine)}
        for row, consistent in ((LUMPED, False), (CONSISTENT, True)):
            hats = {name: exact.radiosity_on_hats(p, consistent) for name, p in power.items()}
            rows[row] = self.images(exact.scan, curve, hats)
        return rows

    def diffuse_ends(self) -> dict[str, Images]:
        """Light enters from all around: what leaves is seen as it does, and diffusely."""
        exact = self.exact
        fine: dict[str, F64] = {}
        seen: dict[tuple[str, str], NDArray[np.floating]] = {}
        for light in self.run.scene.relight.lights:
            density = exact.entering(light)
            for size in dict.fromkeys((c.width, c.height) for c in self.cameras):
                own = [k for k, c in enumerate(self.cameras) if (c.width, c.height) == size]
                images, power = exact.after_diffuse_entry(light.name, density, [self.cameras[k] for k in own])
                assert images is not None
                seen |= {(light.name, self.views[k].name): images[:, at] for at, k in enumerate(own)}
            fine[light.name] = exact.radiosity(power)
        curve = self.curve(fine)
        self.keep_curve(curve)
        smooth = self.images(exact.mesh, Boundary(self.eta), fine)
        return {EXACT_EXIT: seen, SMOOTH: smooth, FLOOR: self.images(exact.mesh, curve, fine)}

    def true_model(self) -> dict[str, Images]:
        """What a model relights that holds the true R_d between the scan's hat functions, projected consistently."""
        exact, hats = self.exact, {}
        for light in self.run.scene.relight.lights:
            density = exact.entering_on_hats(light, Boundary(self.eta))
            _, power = exact.after_diffuse_entry(f"{light.name} on hats", density)
            hats[light.name] = exact.radiosity_on_hats(power, True)
        return {TRUE_MODEL: self.images(exact.scan, self.kept_curve(), hats)}

    def curve(self, radiosity: Mapping[str, F64]) -> Boundary:
        """`best_curve` of all lights and views, for radiosities (2, L, V) on the fine mesh."""
        seen = []
        for light in self.run.scene.relight.lights:
            for view, camera in zip(self.views, self.cameras, strict=True):
                reference = np.asarray(reference_halves(self.folder, light, view), float).mean(axis=0)
                seen.append(SeenRadiosity(camera, reference, radiosity[light.name].mean(axis=0)))
        return best_curve(self.exact.mesh, self.eta, seen)

    def keep_curve(self, curve: Boundary) -> None:
        """For the rows that stand on the floor's."""
        self.place.mkdir(parents=True, exist_ok=True)
        written = {"format_version": 1, "eta": curve.eta, "cosines": curve.cosines, "ratio": curve.ratio}
        write_json(self.place / "curve.json", written)

    def kept_curve(self) -> Boundary:
        """What `keep_curve` kept: the group before this one wrote it."""
        kept = read_json(self.place / "curve.json", _Curve, "delete twin/budget.json, then repeat the command")
        return Boundary(kept.eta, kept.cosines, kept.ratio)

    def images(self, mesh: Any, boundary: Boundary, radiosity: Mapping[str, F64]) -> Images:
        """Of (2, L, V) radiosities on a mesh, by light; in all views."""
        out: dict[tuple[str, str], NDArray[np.floating]] = {}
        for view, camera in zip(self.views, self.cameras, strict=True):
            seen = ViewOfMesh(camera, mesh, boundary)
            out |= {(light, view.name): np.stack([seen.image(h) for h in b]) for light, b in radiosity.items()}
        return out

    # ---- the method, given exact samples

    def exact_samples(self) -> dict[str, Images]:
        """Its samples replaced by the object's own R_d between the beams and the hat functions, where it has some.

        Light enters diffusely over the beams' footprints, so that nothing but completion is left to err.
        """
        own = load_samples(self.folder.work / "samples.npz")
        value, variance = self.exact.spot_responses(own.spots)
        observed = np.isfinite(own.values) & (value > 0)  # where no photon came nothing is known
        nothing = np.zeros(own.values.shape, np.float32)
        samples = replace(
            own,
            values=np.where(observed, value, np.nan).astype(np.float32),
            dark_variance=variance.astype(np.float32),
            noise_per_signal=nothing,
            oblique=np.zeros_like(own.oblique),
            direction_bias=np.zeros_like(own.direction_bias),
            glow=(),
        )
        model, smooth = reconstruct(samples, self.method), Boundary(self.eta)
        # As the rows of light: the floor's curve at the exit, the smooth F_t at the entry.
        lit = {x.name: LightOnMesh(x, model.mesh, smooth, model.lasers) for x in self.run.scene.relight.lights}
        out: dict[tuple[str, str], NDArray[np.floating]] = {}
        for view, camera in zip(self.views, self.cameras, strict=True):
            seen = ViewOfMesh(camera, model.mesh, self.kept_curve())
            for name, light in lit.items():
                total = np.sum([term.image(light, seen) for term in model.terms], axis=0)
                out[name, view.name] = _twice(total)
        return {EXACT_SAMPLES: out}

    # ---- the whole job

    def relit(self, folder: RunFolder) -> Images:
        """What the pipeline left."""
        lights = self.run.scene.relight.lights
        return {
            (light.name, view.name): _twice(load_relit(folder, self.method, light.name, view))
            for light in lights
            for view in self.views
        }

    def recalibrated(self, own: Calibration, name: str) -> Images:
        """The job with another calibration: the nominal one, or a part of the measured one made true."""
        scene = self.run.scene
        nominal = nominal_calibration(scene.rig, own.sensor)
        true = true_calibration(scene.rig, actual_rig(scene.rig, scene.seed), nominal)
        variant = self.variant(name)
        given = variant.root / "calibration.json"
        (nominal if name == NOMINAL else VARIANTS[name](own, true)).save(given)
        reconstruct_apart(scene, variant, (self.method,), given)
        return self.relit(variant)

    def exact_scan(self) -> Images:
        """The job on the same images with a scan that has no error, calibrated anew from them."""
        faultless = self.run.scene.rig.model_copy(
            update={"faults": self.run.scene.rig.faults.model_copy(update={"scanner": False})}
        )
        scan = Experiment(self.run.scene.model_copy(update={"rig": faultless})).scan
        variant = self.variant("exact scan", linked=lambda path: path.name != "scan.ply")
        (variant.capture / "scan.ply").write_bytes(bytes(scan.export(file_type="ply")))
        reconstruct_apart(self.run.scene, variant, (self.method,))
        return self.relit(variant)

    def quiet_camera(self) -> Images:
        """The job on images of the same light by cameras whose photons and electronics do not fluctuate."""
        kept = {"scan.ply", "rig.json", "sensor.json", "calibration"}
        variant = self.variant("quiet camera", linked=lambda path: path.name in kept)
        rig = twin_rig(self.experiment, self.folder.twin / "responses")
        for camera in rig.cameras:
            assert isinstance(camera, TwinCamera)
            camera.optics = _Quiet(**vars(camera.optics))
        capture(rig, self.experiment.plan, variant.capture)
        reconstruct_apart(self.run.scene, variant, (self.method,))
        return self.relit(variant)

    def variant(self, name: str, linked: Callable[[Path], bool] | None = None) -> RunFolder:
        """A folder to reconstruct in, begun anew; with `linked`, one whose capture holds links to those files only."""
        root = self.place / name.replace(" ", "-")
        shutil.rmtree(root, ignore_errors=True)
        folder = self.folder.variant(root)
        folder.work.mkdir(parents=True)
        if linked is not None:
            folder.capture = root / "capture"
            folder.capture.mkdir()
            for path in filter(linked, self.folder.capture.iterdir()):
                (folder.capture / path.name).symlink_to(path.resolve())
        return folder


class _Curve(Strict):
    """The floor's boundary curve."""

    format_version: Literal[1]
    eta: float
    cosines: tuple[float, ...]
    ratio: tuple[float, ...]


class _Quiet(Lars3):
    """The camera whose photons and electronics do not fluctuate; a dither of one digital number keeps means right."""

    def expose(self, radiance: F32, laser: int, rng: Any, exponent: int | None = None) -> RawImage:
        """As `Lars3.expose`."""
        dither = self.sensor.gain_e_per_dn / max(self.sensor.read_noise_e, 1e-9)
        return super().expose(radiance, laser, _Expectation(rng, dither), exponent)  # type: ignore[arg-type]


@dataclass(frozen=True)
class _Expectation:
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
