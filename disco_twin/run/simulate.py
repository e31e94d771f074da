"""The twin's stages of a run: scan, capture, ground truth. Each writes its files into the run folder."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.run_folder import RunFolder
from hw.base.errors import InputError
from hw.base.files import write_atomically
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.plan.visibility import require_in_sight
from pipeline.records import RigFile, SensorFile

if TYPE_CHECKING:
    from disco_twin.emulation.twin_rig import TwinRig
    from disco_twin.light.truth import Truth
    from hw.record import Sensor
    from pipeline.capture.loop import CaptureReport, Progress

COLUMNS_AT_ONCE = 4  # columns of truth between two words on the progress


def sensor_of(experiment: Experiment, real: Sensor | None = None) -> Sensor:
    """What the pipeline is told of the sensor: a real camera's, or the twin's."""
    from disco_twin.camera.lars3 import lars3_sensor

    return lars3_sensor(experiment.scene.rig) if real is None else real


def write_scan(experiment: Experiment, capture: Path, sensor: Sensor | None = None) -> None:
    """The nominal rig, its sensor, the scanned mesh: what the pipeline is told beside the images and their plan."""
    require_capturable(experiment)
    write_atomically(capture / "scan.ply", bytes(experiment.scan.export(file_type="ply")))
    nominal = experiment.scene.rig.nominal()
    known = SensorFile(format_version=1, sensor=sensor_of(experiment, sensor))
    write_atomically(capture / "rig.json", RigFile(format_version=1, rig=nominal).model_dump_json(indent=1).encode())
    write_atomically(capture / "sensor.json", known.model_dump_json(indent=1).encode())


def require_capturable(experiment: Experiment) -> None:
    """Refuse a scene whose devices do not reach the object, before anything is simulated."""
    _require_equal_sizes(experiment.scene.rig.cameras, "rig.cameras")
    for i, view in enumerate(experiment.scene.relight.views):
        require_in_sight(view, experiment.scan, f"relight.views[{i}]", f"the held-out view {view.name!r}")
    experiment.plan  # noqa: B018 - the plan refuses cameras, projector and spots that cannot be
    from pipeline.calibrate.projector_fit import LEAST_SPOTS

    rig = experiment.scene.rig
    if rig.faults.deviation and rig.spots < LEAST_SPOTS:
        raise InputError(
            "too few to find the projector from, and the rig is off the nominal one", key="rig.spots", value=rig.spots,
            allowed=f"at least {LEAST_SPOTS} that a camera sees", remedy="more spots, or --no-faults",
        )  # fmt: skip


def _require_equal_sizes(cameras: Sequence[CameraConfig], key: str) -> None:
    sizes = {(c.width, c.height) for c in cameras}
    if len(sizes) > 1:
        remedy = "give all of them one width and height"
        raise InputError("the twin's cameras must have one image size", key=key, value=sorted(sizes), remedy=remedy)


def _later(progress: Progress, before: int, total: int, done: int, _: int) -> None:
    """One of several captures as a part of the whole."""
    progress(before + done, total)


def take_targets(experiment: Experiment, folder: RunFolder, progress: Progress) -> None:
    """The calibration images, camera by camera, into the capture's folder; continues where it was interrupted."""
    from disco_twin.camera.targets import TargetSource
    from disco_twin.emulation.twin_rig import BracketRig, TargetRig
    from disco_twin.faults.actual_rig import actual_rig
    from pipeline.capture.loop import capture
    from pipeline.plan.targets import BRACKET, FOLDER, TARGETS, make_bracket, make_targets

    rig, seed = experiment.scene.rig, experiment.scene.seed
    actual, made = actual_rig(rig, seed), [make_targets(rig, c) for c in range(len(rig.cameras))]
    total, before = sum(len(plan) for _, plan in made), 0
    for c, (targets, plan) in enumerate(made):
        own = folder.capture / FOLDER / targets.camera
        own.mkdir(parents=True, exist_ok=True)
        source = TargetSource(targets, actual.cameras[c], actual, rig.projector.beam_diameter_mm / 2)
        twin = TargetRig(rig, source, seed, actual, c, len(targets.placements))
        capture(twin, plan, own, partial(_later, progress, before, total))
        if rig.sensor.response == "curved":
            still, exposures = make_bracket(rig, c)
            source = TargetSource(still, actual.cameras[c], actual, rig.projector.beam_diameter_mm / 2)
            capture(BracketRig(rig, source, seed, actual, c, len(exposures.angles_rad)), exposures, own / BRACKET)
        write_atomically(own / TARGETS, targets.model_dump_json(indent=1).encode())
        before += len(plan)


def twin_rig(experiment: Experiment, folder: RunFolder) -> TwinRig:
    """The twin of the rig in front of the object. Needs the renderer."""
    transport = experiment.transport
    from disco_twin.emulation.twin_rig import TwinRig
    from disco_twin.faults.actual_rig import actual_rig
    from disco_twin.light.response import SpotResponses

    scene = experiment.scene
    actual = actual_rig(scene.rig, scene.seed)
    walks, scratch = scene.simulation.walks_per_spot, folder.twin / "responses"
    responses = SpotResponses(transport, scene.rig, actual, walks, experiment.seed("spots"), scratch)
    return TwinRig(scene.rig, responses, scene.seed, actual)


def take_images(experiment: Experiment, folder: RunFolder, progress: Progress) -> CaptureReport:
    """The capture by the twin of the rig; continues where it was interrupted."""
    from pipeline.capture.loop import capture

    return capture(twin_rig(experiment, folder), experiment.plan, folder.capture, progress)


def compute_truth(experiment: Experiment, path: Path, progress: Progress) -> None:
    """Columns of the true R_d, from photons of their own."""
    columns, walks = experiment.truth_columns(), experiment.scene.simulation.truth_walks
    parts = []
    for low in range(0, len(columns), COLUMNS_AT_ONCE):
        part = columns[low : low + COLUMNS_AT_ONCE]
        parts.append(experiment.truth(part, walks))
        progress(low + len(part), len(columns))
    joined(parts).save(path)


def joined(parts: Sequence[Truth]) -> Truth:
    """Truth of several sets of columns as one; the balance is the mean over columns."""
    from disco_twin.light.balance import EnergyBalance
    from disco_twin.light.truth import Truth

    weights = [len(p.columns) for p in parts]
    names = EnergyBalance.__dataclass_fields__
    mean = {k: np.average([getattr(p.balance, k) for p in parts], axis=0, weights=weights) for k in names}
    return Truth(
        np.concatenate([p.columns for p in parts]),
        np.concatenate([p.mean for p in parts], axis=1),
        np.concatenate([p.standard_error for p in parts], axis=1),
        parts[0].area,
        EnergyBalance(**mean),
    )
