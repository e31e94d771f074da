"""The stress suite: every quick case ends as it is to end, the slow ones too; and a verdict is what it says."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
import trimesh

from benchmarks import stability
from benchmarks.stability import case as module
from benchmarks.stability.case import Case, Ends, Family, Verdict, outcome
from benchmarks.stability.page import page
from hw.base.errors import DiscoError, InputError
from pipeline.reconstruct.medium.tetrahedra import NoMedium

QUICK = stability.cases(slow=False)
NAMES = [f"{case.family}: {case.name}" for case in QUICK]


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("case", QUICK, ids=NAMES)
def test_quick_case(case: Case) -> None:
    row = case.row()
    assert row["as_expected"], row


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    "case", [c for c in stability.cases(slow=True) if c.slow], ids=lambda c: f"{c.family}: {c.name}"
)
def test_slow_case(case: Case) -> None:
    row = case.row()
    assert row["as_expected"], row


def test_there_are_as_many_as_asked_for_and_each_has_a_name_of_its_own() -> None:
    every = stability.cases(slow=True)
    assert len(every) >= 80
    assert len({(c.family, c.name) for c in every}) == len(every)
    assert all(c.expected and c.extent for c in every)
    assert sum(bool(c.rivals) for c in every) >= 10


def raising(error: Exception) -> object:
    def find() -> float:
        raise error

    return find


@pytest.mark.parametrize(
    ("find", "verdict"),
    [
        (lambda: 0.5, Verdict.RIGHT),
        (lambda: 1.5, Verdict.WRONG),
        (lambda: math.nan, Verdict.WRONG),
        (lambda: -math.inf, Verdict.WRONG),
        (raising(DiscoError("no. Remedy: yes")), Verdict.REFUSED),
        (raising(DiscoError("two\nlines. Remedy: yes")), Verdict.WRONG),
        (raising(DiscoError("nothing can be done")), Verdict.WRONG),
        (raising(NoMedium("the samples leave D open")), Verdict.REFUSED),
        (raising(NoMedium("two\nlines")), Verdict.WRONG),
        (raising(InputError("no remedy", allowed="1")), Verdict.WRONG),
        (raising(InputError("no remedy", key="a")), Verdict.WRONG),
        (raising(InputError("no", remedy="yes")), Verdict.REFUSED),
        (raising(ValueError("x")), Verdict.CRASHED),
        (raising(np.linalg.LinAlgError("x")), Verdict.CRASHED),
    ],
)
def test_verdicts(find: module.Find, verdict: Verdict) -> None:
    assert outcome(find, 1.0).verdict is verdict


@pytest.mark.parametrize(("says", "expected"), [("", True), ("below 0", True), ("not symmetric", False)])
def test_a_refusal_for_another_reason_is_not_as_expected(says: str, expected: bool) -> None:
    find = raising(InputError("holds values below 0", remedy="yes"))
    assert Case("a", "b", "c", "d", find, ends=Ends.REFUSED, says=says).row()["as_expected"] is expected


def test_what_hangs_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LONGEST_S", 0.05)

    def find() -> float:
        end = time.monotonic() + 5
        while time.monotonic() < end:
            pass
        return 0.0

    assert outcome(find, 1.0).verdict is Verdict.HUNG


def test_the_page_has_a_line_for_every_case(monkeypatch: pytest.MonkeyPatch) -> None:
    family = Family("made up")
    family.case("one", "right", "small", 1.0, rivals={"other": lambda: 7.0})(lambda: 0.25)
    family.case("two", "refused", "large", ends=Ends.REFUSED)(raising(InputError("no", remedy="yes")))
    monkeypatch.setattr(stability, "cases", lambda slow: family.cases)
    record = stability.run() | {"commit": "abc", "seconds": 1.0, "cores": 2}
    assert (record["verdicts"], record["not_as_expected"]) == ({"right": 1, "refused": 1}, 0)
    text = page(record)
    assert "| one | small | right | 0.25 (1) | right | other: silently wrong, 7 |" in text
    assert "| two | large | refused | - | refused |  |" in text


def unchecked(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices, faces, process=False)


BROKEN: list[tuple[str, str, str, object]] = [
    ("camera", "charge at the boundary of exposure 3", "hw.record._decision_bias", lambda e, *_: np.zeros_like(e)),
    ("surface", "facets project to the surface, alpha 0.3", "benchmarks.stability.surface.ggx", lambda c, a: 0.3 * c),
    (
        "solvers",
        "a bounded mean that is known exactly",
        "benchmarks.stability.solvers.at_most_zero",
        lambda m, d: m / d,
    ),
    ("calibration", "spots in a plane", "pipeline.calibrate.projector_fit.FLAT", 0.0),
    (
        "completion",
        "the smooth field, weights over 6 decades",
        "pipeline.reconstruct.global_term.completion.TOLERANCE",
        0.9,
    ),
    ("diffusion", "points in one plane", "pipeline.reconstruct.medium.tetrahedra.QhullError", KeyError),
    ("meshes", "a scan: a hole", "pipeline.geometry.mesh_file.require_closed", lambda *_: None),
    ("files", "a model's file with vertices all in one place", "pipeline.model.relightable._surface", unchecked),
    (
        "files",
        "a model's file with a variance below 0",
        "pipeline.model.reflectance.GlobalTerm.check",
        lambda *_: None,
    ),
    (
        "files",
        "a model's file with an albedo below 0",
        "pipeline.model.lambertian.LambertianTerm.check",
        lambda *_: None,
    ),
    ("relighting", "parallel light on a ball of 1 mm", "pipeline.relight.irradiance._RULE", np.full((3, 3), 0.4)),
    ("media", "albedo 0.9999999", "disco_twin.scene.object_schema.MOST_ALBEDO", 1.0),
    ("media", "an object that scatters nothing, albedo 0", "disco_twin.run.scan.LEAST_SCATTERED", 0.0),
]


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(("family", "name", "target", "broken"), BROKEN, ids=[family for family, *_ in BROKEN])
def test_a_broken_kernel_shows(
    family: str, name: str, target: str, broken: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A case of each family whose kernel, or whose guard, is taken out."""
    (case,) = [c for c in QUICK if (c.family, c.name) == (family, name)]
    assert case.row()["as_expected"]
    monkeypatch.setattr(target, broken)
    assert not case.row()["as_expected"]
