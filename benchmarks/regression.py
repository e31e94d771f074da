"""What the comparison with stored scores catches and what it calls worse by mistake, on the frozen captures.

    python -m benchmarks regression --json FILE

`power`: by stage, the share of perturbations called worse, each of which makes one figure of the stage a tenth worse.
`false_alarm_rate`: the share of figures called worse between two outputs that err alike. Their errors about the mean of
truth and references mirror each other, and these are drawn anew: each replicate, or half, is that mean and the noise
that it was seen to have, with random signs column by column, or random factors block of pixels by block. A rate of one
in a thousand takes too many draws to be seen; what is measured at `LEVEL` is stated beside it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.frozen import SCENES, Frozen, grown
from benchmarks.frozen_scores import load_scores
from benchmarks.perturbations import PERTURBATIONS, made_worse, stage_outputs
from disco_twin.evaluate.compare import ALPHA, Difference, compare
from disco_twin.evaluate.stage_figures import FIGURES, StageOutputs, TrueRun
from pipeline.relight.scores import BLOCK

REPETITIONS = 20
DRAWS = 40
LEVEL = 0.05  # of one figure, at which false alarms are counted
NOT_ALIKE = ("totals", "bias")  # of mirrored entries: what they sum to, and where noise in a logarithm has a mean


def caught(stored: StageOutputs, slack: Mapping[str, float], true: TrueRun, repetitions: int) -> dict[str, list[bool]]:
    """By stage, whether each perturbed output is called worse."""
    out: dict[str, list[bool]] = {stage: [] for stage in FIGURES}
    for stage, own in stage_outputs(stored):
        before = FIGURES[stage](own, true)
        names = [name for name, value in before.items() if 0.1 * abs(value) > 2 * slack[name]]  # next to nothing: no
        for k in range(repetitions if names else 0):
            rng = np.random.default_rng(k)
            name, perturbation = names[k % len(names)], PERTURBATIONS[stage][k % len(PERTURBATIONS[stage])]
            bad = made_worse(stage, own, true, perturbation, name, int(rng.integers(1 << 31)))
            if bad is not None:
                whole = replace(bad, images=stored.images | bad.images)
                out[stage].append(bool(grown(compare(stored, whole, true), slack)))
    return out


def drawn_anew(true: TrueRun, rng: np.random.Generator) -> TrueRun:
    """Truth and references about the same means, with other noise of the same size."""
    r = true.truth.replicates.astype(np.float64)
    n, mean = len(r), r.mean(axis=0)
    noise = (r - mean) * np.sqrt(n / (n - 1)) * rng.choice([-1.0, 1.0], (n, r.shape[1], r.shape[2], 1))
    halves = {}
    for key, (a, b) in true.halves.items():
        middle, half = 0.5 * (a.astype(np.float64) + b), 0.5 * (a.astype(np.float64) - b)
        blocks = rng.standard_normal((2, *(-(-size // BLOCK) for size in middle.shape[1:])))
        signs = blocks.repeat(BLOCK, 1).repeat(BLOCK, 2)[:, None, : middle.shape[1], : middle.shape[2]]
        halves[key] = middle + np.sqrt(2.0) * signs * half
    return replace(true, truth=replace(true.truth, replicates=mean + noise), halves=halves)


def mirrored(outputs: StageOutputs, true: TrueRun) -> StageOutputs:
    """Outputs whose entries and images err as much to the other side of the truth's and the references' means."""
    exitance = outputs.exitance
    assert exitance is not None
    mean = true.truth.mean
    other = np.where((mean > 0) & (exitance > 0), mean**2 / np.where(exitance > 0, exitance, 1.0), exitance)
    images = {key: np.mean(true.halves[key], axis=0, dtype=np.float64) * 2 - x for key, x in outputs.images.items()}
    return replace(outputs, exitance=other, images=images)


def by_chance(stored: StageOutputs, true: TrueRun, draws: int, seed: int) -> list[Difference]:
    """Differences of figures between outputs that err alike, in this many draws of the noise that judges them."""
    rng, other, out = np.random.default_rng(seed), mirrored(stored, true), list[Difference]()
    for k in range(draws):
        pair = (stored, other) if k % 2 else (other, stored)
        found = compare(*pair, drawn_anew(true, rng))
        out += [d for d in found if d.error > 0 and d.stage != "samples" and not any(x in d.figure for x in NOT_ALIKE)]
    return out


def run(quick: bool = False) -> dict[str, Any]:
    """Over all objects; `quick`: one of them, few repetitions."""
    power: dict[str, list[bool]] = {stage: [] for stage in FIGURES}
    chances: list[Difference] = []
    objects = list(SCENES)[:1] if quick else list(SCENES)
    for seed, name in enumerate(objects):
        frozen = Frozen.load(name)
        stored, slack = load_scores(frozen.scores_file)
        for stage, own in caught(stored, slack, frozen.true, 2 if quick else REPETITIONS).items():
            power[stage] += own
        chances += by_chance(stored, frozen.true, 4 if quick else DRAWS, seed)
    alarms = [d.chance() < LEVEL for d in chances]
    return {
        "captures": len(objects),
        "repetitions": sum(map(len, power.values())),
        "power": {stage: float(np.mean(own)) for stage, own in power.items() if own},
        "level": LEVEL,
        "false_alarm_rate": float(np.mean(alarms)),
        "draws": len(alarms),
        "alpha": ALPHA,
        "false_alarms_at_alpha": float(np.mean([d.chance() < ALPHA for d in chances])),
    }
