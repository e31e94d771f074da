"""Differences of figures between two outputs of one capture: their sizes, their standard errors, and what is worse."""

from __future__ import annotations

from dataclasses import fields as dataclass_fields
from dataclasses import replace

import numpy as np
import pytest
from perfect_stages import perfect

from disco_twin.evaluate.compare import ALPHA, Difference, compare, sidak, worse
from disco_twin.evaluate.stage_figures import StageOutputs, TrueRun
from pipeline.reconstruct.samples.spots import Spots

REPLICATES = 8
UP = np.array([0.0, 0.2, 0.0])


def small() -> tuple[StageOutputs, TrueRun]:
    """As `perfect`, with six columns and ten spots."""
    outputs, true = perfect()
    truth = replace(true.truth, columns=true.truth.columns[:6], replicates=true.truth.replicates[:, :, :6])
    own, exitance = outputs.spots, outputs.exitance
    assert exitance is not None
    fields = {f.name: getattr(own, f.name)[:10] for f in dataclass_fields(Spots) if f.name != "beam_radius"}
    spots, values = replace(own, **fields), outputs.values[:, :10]
    few = replace(outputs, exitance=exitance[:, :6], lit=outputs.lit[:6], spots=spots, values=values)
    return few, replace(true, truth=truth, hits=true.hits[:10])


def by_figure(differences: list[Difference]) -> dict[str, Difference]:
    return {d.figure: d for d in differences}


def test_equal_outputs_differ_by_nothing() -> None:
    outputs, true = small()
    found = compare(outputs, outputs, true)
    assert all(d.difference == 0 for d in found)
    assert not worse(found)


def test_a_stage_that_got_worse_is_named_and_one_that_got_better_is_not() -> None:
    """Exact figures: any growth beyond the slack is one."""
    outputs, true = small()
    off = replace(outputs, spots=replace(outputs.spots, position=outputs.spots.position + UP))
    further = replace(outputs, spots=replace(outputs.spots, position=outputs.spots.position + 1.1 * UP))
    grown = by_figure(compare(off, further, true))["spots/place mm"]
    assert grown.difference == pytest.approx(0.02)
    assert grown.error == 0
    assert "spots/place mm" in by_figure(worse([grown]))
    assert not worse([grown], {"spots/place mm": 0.021})
    assert not worse([grown.swapped])


def test_what_is_gone_is_worse_where_all_is_asked_for() -> None:
    outputs, true = small()
    without = replace(outputs, exitance=None)
    gone = {d.figure for d in compare(outputs, outputs, true)} - {d.figure for d in compare(outputs, without, true)}
    assert any(name.startswith("completion/") for name in gone)
    assert gone <= {d.figure for d in worse(compare(outputs, without, true, whole=True))}


def test_an_unknown_error_makes_nothing_worse_by_chance() -> None:
    assert not worse([Difference("completion/x", 0.1, 0.2, 0.1, np.nan)])
    assert worse([Difference("completion/x", 0.1, 0.2, 0.1, 0.0)])
    assert worse([Difference("completion/x", 0.1, np.inf, np.inf, np.nan)])


@pytest.fixture(scope="module")
def judged_anew() -> list[dict[str, Difference]]:
    """Two outputs that err differently, judged many times by truth and references of other noise."""
    outputs, true = small()
    outputs = replace(outputs, values=np.full_like(outputs.values, np.nan))  # they take the longest
    rng = np.random.default_rng(0)
    mean, image = true.truth.mean, true.halves["uniform", "left"][0]

    def erring(scale: float, by: float) -> StageOutputs:
        entries = by * mean * np.exp(scale * rng.standard_normal(mean.shape))
        shown = by * image * np.exp(scale * rng.standard_normal(image.shape))
        return replace(outputs, exitance=entries, images={("uniform", "left"): shown})

    def judge() -> TrueRun:
        replicates = mean * (1 + 0.1 * rng.standard_normal((REPLICATES, *mean.shape)))
        halves = image * (1 + 0.1 * rng.standard_normal((2, *image.shape)))
        return replace(true, truth=replace(true.truth, replicates=replicates), halves={("uniform", "left"): halves})

    one, other = erring(0.1, 1.05), erring(0.15, 1.08)
    return [by_figure(compare(one, other, judge())) for _ in range(30)]


@pytest.mark.parametrize(
    "figure", ["completion/decade 0 log10 rmse", "relit/uniform@left nrmse", "relit/uniform@left energy - 1"]
)
def test_standard_errors_are_those_of_the_noise_that_judges(
    judged_anew: list[dict[str, Difference]], figure: str
) -> None:
    """Expected: the difference scatters as its error says, no more and no less."""
    found = [differences[figure] for differences in judged_anew]
    scatter, stated = np.std([d.difference for d in found]), np.sqrt(np.mean([d.error**2 for d in found]))
    assert scatter > 0
    assert 0.65 < scatter / stated < 1.45, (scatter, stated)


def test_what_a_method_does_not_state_is_not_compared() -> None:
    outputs, true = small()
    found = compare(replace(outputs, exitance=None), outputs, true)
    assert {d.stage for d in found} == {"pose", "projector", "spots", "samples", "relit"}


def test_many_figures_are_judged_together() -> None:
    """Rationale: a chance of .001 over all, however many there are; what is no number any more is worse."""
    assert sidak(1 - (1 - ALPHA) ** (1 / 150), 150) == pytest.approx(ALPHA)
    close = Difference("relit/a@b nrmse", 0.1, 0.11, 0.01, 0.01 / 3.5)  # three and a half standard errors
    assert worse([close])
    assert not worse([close], others=149)
    assert worse([Difference("relit/a@b nrmse", 0.1, np.inf, np.inf)])
    assert not worse([Difference("relit/a@b nrmse", np.inf, np.inf, np.nan)])
