"""What the quick scene's figures are, stage by stage, how far they may move, and proof that the limits catch a slip.

    python -m benchmarks quick-figures --json tests/regression/figures.json

The simulated capture is reproducible, so on the same capture a figure moves only where the pipeline does: its limit is
the committed figure and a tolerance far below a tenth of it, but above what other linear algebra kernels and numbers of
threads do (measured here). A change of the simulation, or a processor on which photons round to other paths, makes
another capture: then the limit is a bound from the spread of the figures over fresh captures, each of another seed and
so of another rig, another scan and other noise. `caught_from` is the growth of an error that this wider bound catches.

Shown beside them: `power`, the share of perturbations caught, each of which makes one figure of a stage a tenth worse;
`false_alarm_rate`, the share of runs refused that are as good as the committed one: repetitions with other kernels, and
fresh captures judged by the bound from the other ones.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from scipy.stats import t as student

from benchmarks.frozen import environment
from benchmarks.perturbations import PERTURBATIONS, WORSE, made_worse, stage_outputs
from disco_twin.evaluate.stage_figures import (
    FIGURES,
    StageOutputs,
    TrueRun,
    all_figures,
    load_outputs,
    load_true_run,
)
from disco_twin.experiment.pipeline_process import reconstruct_apart
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.light.truth import Truth
from disco_twin.run.stages import Run, begin_run, capture_stages, pipeline_stage, truth_stages

REPOSITORY = Path(__file__).resolve().parents[1]
SCENE = REPOSITORY / "scenes" / "quick.toml"
RUNS = REPOSITORY / "out" / "quick-figures"  # kept: a changed pipeline finds its captures here
METHOD = "default"
FRESH = 10
TOLERANCE = 0.01  # of a figure, at least; a tenth worse has to stay far outside
FALSE_ALARMS = 0.01  # of fresh captures, over all figures together
KERNELS = ("Prescott", "Haswell", "SkylakeX")  # OpenBLAS: without FMA, with AVX2, with AVX-512


@dataclass(frozen=True)
class Limit:
    """frozen: a figure on the committed capture; tolerance: how much worse it may be there; bound: on any capture.

    moved: the most that other linear algebra kernels moved it; caught_from: error, over the frozen one, that the bound
    catches.
    """

    frozen: float
    moved: float
    tolerance: float
    bound: float
    caught_from: float

    def allowed(self, same_capture: bool) -> float:
        """The largest error that passes."""
        return abs(self.frozen) + self.tolerance if same_capture else self.bound


def too_large(
    figures: Mapping[str, float], limits: Mapping[str, Limit], same_capture: bool, partly: bool = False
) -> dict[str, str]:
    """The figures whose errors are beyond their limits, each with both numbers; what is no number is beyond, and so is
    a figure that is not there, unless only a part is given (`partly`).
    """
    missing = set() if partly else set(limits) - set(figures)
    return {name: f"missing (committed {limits[name].frozen:+.5g})" for name in sorted(missing)} | {
        name: f"{value:+.5g} (allowed {limits[name].allowed(same_capture):.5g}, committed {limits[name].frozen:+.5g})"
        for name, value in figures.items()
        if not abs(value) <= limits[name].allowed(same_capture)
    }


def bounds(samples: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """By figure, what one more capture exceeds with a probability of `FALSE_ALARMS` over all figures (Student's t)."""
    n, names = len(samples), list(samples[0])
    reach = float(student.ppf(1 - FALSE_ALARMS / len(names), n - 1)) * np.sqrt(1 + 1 / n)
    values = {name: np.array([s[name] for s in samples]) for name in names}
    return {k: abs(float(v.mean())) + reach * float(v.std(ddof=1)) for k, v in values.items()}


def fingerprint(folder: RunFolder) -> str:
    """Of the images, the scan and the truth: equal where the same photons were simulated."""
    digest = hashlib.blake2b(Truth.load(folder.twin / "truth.npz").mean.tobytes(), digest_size=16)
    for path in (*sorted(folder.capture.glob("**/images.bin")), folder.capture / "scan.ply"):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def processor() -> str:
    """The processor's name, family, model and stepping, on which the rounding of photons' paths depends; elsewhere than
    on Linux its architecture.
    """
    info = Path("/proc/cpuinfo")
    lines = info.read_text().split("\n\n")[0].splitlines() if info.is_file() else []
    known = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    parts = [known[key] for key in ("model name", "cpu family", "model", "stepping") if key in known]
    return " ".join(parts) or platform.machine()


def power(
    outputs: StageOutputs, true: TrueRun, limits: Mapping[str, Limit], repetitions: int
) -> tuple[dict[str, float], int]:
    """By stage, the share of perturbations that are caught on the same capture; and how many there were."""
    caught: dict[str, list[bool]] = {stage: [] for stage in FIGURES}
    for stage, own in stage_outputs(outputs):
        for name in FIGURES[stage](own, true):
            tries = [
                made_worse(stage, own, true, perturbation, name, seed)
                for perturbation in PERTURBATIONS[stage]
                for seed in range(repetitions)
            ]
            worse = [FIGURES[stage](outputs, true) for outputs in tries if outputs is not None]
            caught[stage] += [bool(too_large(figures, limits, True, partly=True)) for figures in worse] or [False]
    return {stage: float(np.mean(c)) for stage, c in caught.items()}, sum(len(c) for c in caught.values())


# The command ---------------------------------------------------------------------------------------------------------


def take_run(seed: int, quick: bool) -> Run:
    """A whole run but for its scores, in a folder that is kept; what is finished there is not done again."""
    folder = RUNS / f"{'small' if quick else 'full'}-{seed}"
    RUNS.mkdir(parents=True, exist_ok=True)
    scene = RUNS / f"seed-{seed}.toml"
    text = SCENE.read_text()
    assert text.count("\nseed = 1\n") == 1
    scene.write_text(text.replace("\nseed = 1\n", f"\nseed = {seed}\n"))
    run = begin_run(scene, folder, "small" if quick else "full", METHOD, Console(quiet=True))
    run = replace(run, methods=(METHOD,), scene_file=SCENE)  # without the baselines; beside the committed references
    capture_stages(run)
    truth_stages(run)
    pipeline_stage(run)
    return run


def figures_of(run: Run, folder: RunFolder | None = None) -> dict[str, float]:
    """All figures of a run, or of another pipeline's work on it in `folder`."""
    true = load_true_run(run.experiment, run.folder)
    return all_figures(load_outputs(run.experiment, folder or run.folder, true), true)


def repeated(run: Run) -> list[dict[str, float]]:
    """The pipeline again on the same capture, with each of other linear algebra kernels and two threads."""
    out = []
    for kernel in KERNELS:
        variant = run.folder.variant(run.folder.root / f"kernel-{kernel}")
        variant.work.mkdir(parents=True, exist_ok=True)
        with environment(OPENBLAS_CORETYPE=kernel, OPENBLAS_NUM_THREADS="2"):
            reconstruct_apart(run.scene, variant, run.methods)
        out.append(figures_of(run, variant))
    return out


def make_limits(
    frozen: Mapping[str, float], repetitions: Sequence[Mapping[str, float]], fresh: Sequence[Mapping[str, float]]
) -> dict[str, Limit]:
    """A limit for every figure.

    Raises: ValueError where kernels move a figure by so much that a tenth would not stand out.
    """
    bound, limits = bounds(fresh), {}
    for name, value in frozen.items():
        if not (np.isfinite(value) and value):
            raise ValueError(f"{name}: {value} is no error that a later one can be compared with")
        moved = max((abs(r[name] - value) for r in repetitions), default=0.0)
        tolerance = max(TOLERANCE * abs(value), 10 * moved)
        if tolerance > 0.5 * (WORSE - 1) * abs(value):
            raise ValueError(f"{name}: {value:.4g} moves by {moved:.1g} with the linear algebra's kernels")
        limits[name] = Limit(value, moved, tolerance, bound[name], bound[name] / abs(value))
    return limits


def false_alarms(
    repetitions: Sequence[Mapping[str, float]], fresh: Sequence[Mapping[str, float]], limits: Mapping[str, Limit]
) -> list[bool]:
    """Which of the runs that are as good as the committed one are refused; each fresh one by the others' bound."""
    refused = [bool(too_large(figures, limits, True)) for figures in repetitions]
    for i, figures in enumerate(fresh):
        others = bounds([*fresh[:i], *fresh[i + 1 :]])
        judged = {name: replace(limit, bound=others[name]) for name, limit in limits.items()}
        refused.append(bool(too_large(figures, judged, False)))
    return refused


def report(
    frozen: tuple[StageOutputs, TrueRun], key: str, repetitions: Sequence[Mapping[str, float]],
    fresh: Sequence[Mapping[str, float]], tries: int,
) -> dict[str, Any]:  # fmt: skip
    """The record that the tests read."""
    limits = make_limits(all_figures(*frozen), repetitions, fresh)
    caught, perturbations = power(*frozen, limits, tries)
    refused = false_alarms(repetitions, fresh, limits)
    return {
        "command": "python -m benchmarks quick-figures --json tests/regression/figures.json",
        "fingerprint": key,
        "processor": processor(),
        "fresh_captures": len(fresh),
        "repetitions": perturbations,
        "power": caught,
        "false_alarm_rate": float(np.mean(refused)),
        "figures": {name: asdict(limit) for name, limit in limits.items()},
        "fresh": [dict(figures) for figures in fresh],
    }


def run(quick: bool = False) -> dict[str, Any]:
    """The record of `report`, after captures, repetitions and perturbations; `quick`: two small fresh captures."""
    first = take_run(1, quick)
    true = load_true_run(first.experiment, first.folder)
    frozen = load_outputs(first.experiment, first.folder, true), true
    fresh = [figures_of(take_run(seed, quick)) for seed in range(2, 2 + (2 if quick else FRESH))]
    return report(frozen, fingerprint(first.folder), [] if quick else repeated(first), fresh, 1 if quick else 5)
