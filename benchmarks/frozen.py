"""Frozen captures: three small objects, captured once by the twin and committed, on which every pipeline is judged.

    python -m benchmarks.frozen make        captures, truth and references into tests/regression/frozen (some minutes)
    python -m benchmarks.frozen store       what the pipeline of now makes of them: what later ones are compared with
    python -m benchmarks.frozen             compares the pipeline of now with what is stored; status 1 where it is worse

A capture is a run folder without stages: the images, the scan and the calibration targets of a rig with every fault;
columns of the truth; references binned from those shipped with the scene, whose pixels they share. Objects are quick
and two of those that constants are chosen on.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.frozen_scores import load_scores, save_scores
from benchmarks.perturbations import WORSE
from disco_twin.cli.tables import difference_table
from disco_twin.evaluate.compare import ALPHA, Difference, compare, worse
from disco_twin.evaluate.stage_figures import StageOutputs, TrueRun, all_figures, load_outputs, load_true_run
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.keys import identity
from disco_twin.experiment.pipeline_process import reconstruct_apart
from disco_twin.experiment.references import read_reference, reference_key, reference_path, shipped_references
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.light.references import Reference, noise_of, save_reference
from disco_twin.scene.scene import Scene, load_scene, shrink
from hw.base.arrays import F32
from pipeline.calibrate.calibration import Calibration

REPOSITORY = Path(__file__).resolve().parents[1]
FROZEN = REPOSITORY / "tests" / "regression" / "frozen"
SCENES = {name: REPOSITORY / "scenes" / f"{name}.toml" for name in ("quick",)} | {
    name: REPOSITORY / "scenes" / "accuracy" / "choose" / f"{name}.toml" for name in ("animal", "ring")
}
METHOD = "default"
VERTICES, COLUMNS = 600, 16
TRUTH_WALKS = {"quick": 40_000, "animal": 40_000, "ring": 5_000}  # a column; windows split the ring's far more often
SCORES = "scores.npz"
SLACK = 0.01  # of a figure, at least
LIMIT = 0.05  # of a figure, that it may be worse by and chance be the reason
NOTHING = 1e-3  # of a bias, which may happen to be next to nothing
KERNEL = "Prescott"  # OpenBLAS without FMA: furthest from those of today's processors


@dataclass(frozen=True)
class Frozen:
    """A frozen capture, its truth, and what a pipeline made of it when scores were stored."""

    name: str
    experiment: Experiment
    folder: RunFolder
    true: TrueRun

    @classmethod
    def load(cls, name: str) -> Frozen:
        """One of `SCENES`, from the committed folder."""
        folder = RunFolder(FROZEN / name)
        experiment = Experiment(folder.read_scene())
        return cls(name, experiment, folder, load_true_run(experiment, folder))

    @property
    def scores_file(self) -> Path:
        """Where its scores are stored."""
        return self.folder.root / SCORES

    def reconstruct(self, root: Path, calibration: Calibration | None = None) -> StageOutputs:
        """What the pipeline of now makes of it, in a process of its own that works in `root`.

        calibration: in place of one of its own, which takes most of the time
        """
        own, given = self.folder.variant(root), None
        own.work.mkdir(parents=True, exist_ok=True)
        if calibration is not None:
            calibration.save(given := root / "calibration.json")
        reconstruct_apart(self.experiment.scene, own, (METHOD,), given)
        return load_outputs(self.experiment, own, self.true, METHOD)


def frozen_scene(path: Path) -> Scene:
    """The scene with a quarter of the spots and of the pixels and a coarser scan; a spot's light is as it was."""
    whole = load_scene(path)
    own = shrink(whole)
    simulation = whole.simulation.model_copy(update={"truth_columns": COLUMNS, "truth_walks": TRUTH_WALKS[whole.name]})
    scan = own.scan.model_copy(update={"vertices": VERTICES})
    reconstruct = own.reconstruct.model_copy(update={"methods": (METHOD,)})
    return own.model_copy(update={"simulation": simulation, "scan": scan, "reconstruct": reconstruct})


def make(name: str) -> None:
    """Capture an object and compute its truth, where it is not there. Needs the renderer; minutes."""
    from disco_twin.experiment.ground_truth import compute_truth
    from disco_twin.run.stages import Run, capture_stages

    path, root = SCENES[name], FROZEN / name
    if (root / "twin" / "truth.npz").is_file() and not (root / "stages.json").is_file():
        return
    scene = frozen_scene(path)
    folder = RunFolder.claim(root, path, identity(scene))  # continues where it was stopped
    folder.write_scene(scene)
    run = Run(Experiment(scene), folder, path, (METHOD,), Console(quiet=True))
    capture_stages(run)
    compute_truth(run.experiment, folder.twin, lambda done, total: None)
    shipped, own = shipped_references(path, scene.name), folder.twin / "references"
    for light in scene.relight.lights:
        for view in scene.relight.views:
            halves = binned(read_reference(reference_path(shipped, light, view)).halves)
            key = reference_key(scene, light, view)
            save_reference(reference_path(own, light, view), Reference(halves, noise_of(halves), key))
    for rest in (*folder.twin.glob("*.key"), folder.twin / "moments.npz", folder.journal, root / "run.log"):
        rest.unlink(missing_ok=True)
    for rest in (folder.twin / "responses", folder.work):
        shutil.rmtree(rest, ignore_errors=True)


def binned(images: F32) -> F32:
    """(..., H, W) -> (..., H / 2, W / 2) means over 2 x 2 pixels: what pixels of twice the size see."""
    *rest, height, width = images.shape
    return np.asarray(images.reshape(*rest, height // 2, 2, width // 2, 2).mean(axis=(-3, -1)), np.float32)


def store(frozen: Frozen, scratch: Path) -> None:
    """What the pipeline of now makes of it, and how far its figures move with another kernel of linear algebra, once
    it is calibrated.

    Raises: ValueError where they move by so much that a tenth would not stand out.
    """
    outputs = frozen.reconstruct(scratch / "own")
    with environment(OPENBLAS_CORETYPE=KERNEL):
        other = frozen.reconstruct(scratch / "other", outputs.calibration)
    slack, moved = {}, all_figures(other, frozen.true)
    for name, value in all_figures(outputs, frozen.true).items():
        least = NOTHING if name.endswith(("bias", "energy - 1")) else 0.0
        slack[name] = max(SLACK * abs(value), 10 * abs(moved[name] - value), least)
        if not slack[name] <= max(0.5 * (WORSE - 1) * abs(value), least):
            raise ValueError(f"{frozen.name} {name}: {value:.4g} moves to {moved[name]:.4g} with another kernel")
    columns = np.asarray(frozen.true.truth.columns)
    save_scores(frozen.scores_file, outputs, columns, len(frozen.true.scan.vertices), slack)


@contextmanager
def environment(**values: str) -> Iterator[None]:
    """A block in which these variables are set, for processes that it starts."""
    before = {key: os.environ.get(key) for key in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for key, value in before.items():
            os.environ.pop(key) if value is None else os.environ.update({key: value})


def differences(frozen: Frozen, outputs: StageOutputs) -> tuple[list[Difference], dict[str, float]]:
    """From what is stored to these outputs; and by figure, what may be worse without a reason."""
    stored, slack = load_scores(frozen.scores_file)
    return compare(stored, outputs, frozen.true, whole=True), slack


def grown(own: Sequence[Difference], slack: Mapping[str, float], alpha: float = ALPHA) -> list[Difference]:
    """The figures of one object that are worse, at a level of `alpha` over those of all objects together; and those
    that are worse by a twentieth whatever chance says: nothing but the pipeline can have moved them.
    """
    beyond_chance = {d.figure for d in worse(own, slack, alpha, (len(SCENES) - 1) * len(own))}
    return [
        d for d in own
        if d.figure in beyond_chance or d.difference > max(LIMIT * abs(d.first), slack.get(d.figure, 0.0))
    ]  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """See the module; 1 where any figure of any object is worse."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.frozen", description="Judge the pipeline of now.")
    parser.add_argument("what", nargs="?", choices=("compare", "make", "store"), default="compare")
    parser.add_argument("--objects", default=",".join(SCENES), help=f"of {', '.join(SCENES)}; left out: all")
    options = parser.parse_args(arguments)
    if unknown := set(options.objects.split(",")) - set(SCENES):
        parser.error(f"argument --objects: {', '.join(sorted(unknown))}: choose from {', '.join(SCENES)}")
    console, found = Console(), dict[str, tuple[list[Difference], dict[str, float]]]()
    for name in options.objects.split(","):
        if options.what == "make":
            make(name)
            continue
        frozen = Frozen.load(name)
        with tempfile.TemporaryDirectory() as scratch:
            if options.what == "store":
                store(frozen, Path(scratch))
                continue
            found[name] = differences(frozen, frozen.reconstruct(Path(scratch)))
    bad = {name: [d.figure for d in grown(own, slack)] for name, (own, slack) in found.items()}
    for name, (own, _) in found.items():
        console.print(f"\n[bold]{name}[/bold]", difference_table(own, "stored", "now"), sep="\n")
        for figure in bad[name]:
            console.print(f"worse: {name} {figure}", highlight=False)
    return int(any(bad.values()))


if __name__ == "__main__":
    sys.exit(main())
