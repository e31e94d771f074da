"""The stage `targets`: the twin's images of calibration targets."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from disco_twin.camera.targets import TargetSource
from disco_twin.emulation.twin_rig import BracketRig, TargetRig
from disco_twin.faults.actual_rig import actual_rig
from hw.base.files import write_atomically
from pipeline.capture.loop import Progress, capture
from pipeline.plan.targets import BRACKET, FOLDER, TARGETS, make_bracket, make_targets

if TYPE_CHECKING:
    from disco_twin.scene.scene import Scene


def take_targets(scene: Scene, folder: Path, progress: Progress) -> None:
    """The calibration images, camera by camera, into the capture's folder; continues where it was interrupted."""
    rig, seed = scene.rig, scene.seed
    actual, made = actual_rig(rig, seed), [make_targets(rig, c) for c in range(len(rig.cameras))]
    total, before = sum(len(plan) for _, plan in made), 0
    for c, (targets, plan) in enumerate(made):
        own = folder / FOLDER / targets.camera
        own.mkdir(parents=True, exist_ok=True)
        source = TargetSource(targets, actual.cameras[c], actual, rig.projector.beam_diameter_mm / 2)
        twin = TargetRig(rig, source, seed, actual, c, len(targets.placements))
        capture(twin, plan, own, lambda done, _, before=before: progress(before + done, total))  # type: ignore[misc]
        if rig.sensor.response == "curved":
            still, exposures = make_bracket(rig, c)
            source = TargetSource(still, actual.cameras[c], actual, rig.projector.beam_diameter_mm / 2)
            capture(BracketRig(rig, source, seed, actual, c, len(exposures.angles_rad)), exposures, own / BRACKET)
        write_atomically(own / TARGETS, targets.model_dump_json(indent=1).encode())
        before += len(plan)
