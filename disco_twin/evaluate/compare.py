"""Two reconstructions of one capture, compared figure by figure: by how much the errors of the second are larger.

Both are judged by the same truth and the same references, so what noise these have counts only where the two differ,
and differences are known far better than either figure is (`pipeline.relight.scores.paired_difference`). Standard
errors are of that noise; the capture is given, not drawn. Where the truth is exact, as for poses, they are 0.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import special

from disco_twin.evaluate.stage_figures import (
    FIGURES,
    StageOutputs,
    TrueRun,
    all_figures,
    completion_figures,
    load_outputs,
    load_true_run,
    sample_figures,
)
from disco_twin.experiment.experiment import Experiment
from disco_twin.experiment.run_folder import RunFolder
from disco_twin.light.truth import Truth
from hw.base.arrays import F64
from hw.base.errors import InputError
from pipeline.reconstruct.samples.distances import beam_footprints
from pipeline.relight.scores import block_sums, paired_difference

ROUNDING = 1e-5  # of a figure: by less nothing is worse
ALPHA = 1e-3  # chance that any of the figures compared is called worse where none is
NOT_CAPTURED = (".part", ".lock")


@dataclass(frozen=True)
class Difference:
    """One figure of two outputs; figures are errors, larger in size where worse.

    figure: its name, the stage before the slash; first, second: its values; difference: by how much the second is
    larger in size; error: standard error of that, NaN where it is unknown; freedom: degrees of freedom that this error
    is known with
    """

    figure: str
    first: float
    second: float
    difference: float
    error: float = 0.0
    freedom: float = math.inf

    @property
    def stage(self) -> str:
        """Which stage's figure it is."""
        return self.figure.partition("/")[0]

    @property
    def swapped(self) -> Difference:
        """The same, seen from the second."""
        return replace(self, first=self.second, second=self.first, difference=-self.difference)

    def chance(self, slack: float = 0.0) -> float:
        """Probability of so large a difference, or a larger one, if the second were worse by `slack` and no more."""
        if math.isnan(self.difference):
            return 1.0 if math.isnan(self.first) or math.isinf(self.first) else 0.0  # it was no number before, either
        excess = self.difference - max(slack, ROUNDING * abs(self.first))
        if self.error == 0 or math.isinf(excess):
            return 0.0 if excess > 0 else 1.0
        if math.isnan(self.error):
            return 1.0  # unknown: chance cannot be ruled out
        z = excess / self.error
        return float(special.ndtr(-z) if math.isinf(self.freedom) else special.stdtr(self.freedom, -z))


def sidak(chance: float, count: int) -> float:
    """Probability that the least of `count` independent chances is as small as this one (Sidak 1967)."""
    return 1.0 if chance >= 1 else float(-np.expm1(count * np.log1p(-chance)))


def worse(
    differences: Sequence[Difference], slack: Mapping[str, float] | None = None, alpha: float = ALPHA,
    others: int = 0,
) -> list[Difference]:  # fmt: skip
    """The figures that are worse in the second by more than their slack, at a level of `alpha` over all of them.

    others: how many more figures are judged elsewhere at this same level
    """
    count = len(differences) + others
    return [d for d in differences if sidak(d.chance((slack or {}).get(d.figure, 0.0)), count) < alpha]


def compare(first: StageOutputs, second: StageOutputs, true: TrueRun, whole: bool = False) -> list[Difference]:
    """Every figure that both outputs have, stage by stage.

    whole: what the second lacks is no number there, and so worse, instead of being left out
    """
    before, after = all_figures(first, true), all_figures(second, true)
    errors = _replicate_errors(first, second, true)
    freedom = len(true.truth.replicates) - 1.0
    out = []
    for name in before:
        if name not in after:
            if whole:
                out.append(Difference(name, before[name], math.nan, math.nan))
            continue
        plain = Difference(name, before[name], after[name], _growth(before[name], after[name]))
        if name in errors:
            plain = replace(plain, error=errors[name], freedom=freedom)
        elif plain.stage == "relit":
            plain = _of_image(plain, first, second, true)
        out.append(plain)
    return out


def _growth(before: float, after: float) -> float:
    return abs(after) - abs(before) if math.isfinite(before) or math.isfinite(after) else math.nan


def _replicate_errors(first: StageOutputs, second: StageOutputs, true: TrueRun) -> dict[str, float]:
    """Standard errors by leaving out one of the truth's replicates after the other (Efron and Stein 1981); NaN where a
    figure is not there without one of them.
    """
    replicates, parts = true.truth.replicates, []
    given = [(o, beam_footprints(true.scan, o.spots)) for o in (first, second)]
    for k in range(len(replicates)):
        truth = true.truth
        less = replace(true, truth=Truth(truth.columns, np.delete(replicates, k, 0), truth.area, truth.balance))
        before, after = (sample_figures(o, less, where) | completion_figures(o, less) for o, where in given)
        parts.append({name: _growth(before[name], after[name]) for name in before if name in after})
    n = len(parts)
    values = {name: np.array([part.get(name, math.nan) for part in parts]) for name in parts[0]}
    return {
        name: float(np.sqrt((n - 1) / n * ((v - v.mean()) ** 2).sum())) if np.isfinite(v).all() else math.nan
        for name, v in values.items()
    }


def _of_image(plain: Difference, first: StageOutputs, second: StageOutputs, true: TrueRun) -> Difference:
    """With the standard error of the difference that the reference's halves leave."""
    image, what = plain.figure.removeprefix("relit/").split(" ", 1)
    light, view = image.split("@")
    one, other = first.images[light, view], second.images[light, view]
    (a, b), mask = true.halves[light, view], true.masks[view]
    size = abs(plain.first) + abs(plain.second)
    if not math.isfinite(size) or size == 0:
        return plain
    if what == "nrmse":  # of squares; a difference of roots is that over their sum
        squares, error = paired_difference(other, one, a, b, mask)
        freedom = _freedom(
            block_sums(((np.asarray(other, np.float64) - one) * (np.asarray(a, np.float64) - b))[:, mask], mask)
        )
        return replace(plain, difference=squares / size, error=error / size, freedom=freedom)
    whole, sums = (block_sums(0.5 * (np.asarray(a, np.float64) + sign * b)[:, mask], mask) for sign in (1, -1))
    pull = math.copysign(1 + plain.second, plain.second) - math.copysign(1 + plain.first, plain.first)
    error = abs(pull) * float(np.sqrt((sums**2).sum()) / whole.sum())
    return replace(plain, error=error, freedom=_freedom(sums))


def _freedom(parts: F64) -> float:
    """Degrees of freedom of a variance that is the sum of the squares of these (Satterthwaite 1946): where a few blocks
    make all the noise, as in the image of a spot, an error is known no better than from as many numbers.
    """
    fourth = float((parts**4).sum())
    return float((parts**2).sum()) ** 2 / fourth if fourth > 0 else math.inf


def compare_runs(first: Path, second: Path, methods: tuple[str, str]) -> list[Difference]:
    """The first method of one run folder and the second one of another, or of the same.

    Judged by the truth and the references of the first folder. Raises: InputError where the folders hold different
    captures, or a file is missing.
    """
    one, other = RunFolder.open(first), RunFolder.open(second)
    if (why := _other_capture(one.capture, other.capture)) is not None:
        raise InputError(
            f"holds another capture than {first}: {why} differs", file=second,
            remedy="reconstruct a copy of the first folder: `cp -r`, then `disco-twin reconstruct --out` the copy",
        )  # fmt: skip
    experiment = Experiment(one.read_scene())
    true = load_true_run(experiment, one)
    before, after = (load_outputs(experiment, f, true, m) for f, m in zip((one, other), methods, strict=True))
    return compare(before, after, true)


def _other_capture(one: Path, other: Path) -> str | None:
    """The first file of a capture that another one lacks or has otherwise; None if they are alike."""
    names = {p.relative_to(folder) for folder in (one, other) for p in folder.rglob("*") if p.is_file()}
    for name in sorted(n for n in names if n.suffix not in NOT_CAPTURED):
        if not ((one / name).is_file() and (other / name).is_file() and _digest(one / name) == _digest(other / name)):
            return str(name)
    return None


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, hashlib.blake2b).hexdigest()


def by_stage(differences: Sequence[Difference]) -> dict[str, list[Difference]]:
    """The stages that have any, in the order of the work."""
    parts = {stage: [d for d in differences if d.stage == stage] for stage in FIGURES}
    return {stage: own for stage, own in parts.items() if own}
