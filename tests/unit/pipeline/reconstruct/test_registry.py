"""The registry: a method is one file, found by itself, and its name is checked before anything heavy is imported."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from reconstruct_synthetic import make

import pipeline.reconstruct
from hw.base.config import check
from hw.base.errors import InputError
from pipeline.reconstruct.methods import reconstruct
from pipeline.reconstruct.registry import known_methods, require_method
from pipeline.reconstruct.settings import ReconstructConfig

MINE = """
from pipeline.reconstruct.baselines.lambertian import fit_lambertian
from pipeline.reconstruct.registry import method

@method("grey", about="the mean albedo", colour="#123456")
def grey(samples):
    return fit_lambertian(samples)
"""


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder that counts as part of the package."""
    monkeypatch.setattr(pipeline.reconstruct, "__path__", [*pipeline.reconstruct.__path__, str(tmp_path)])
    known_methods.cache_clear()
    yield tmp_path
    known_methods.cache_clear()


def test_the_default_comes_first_and_the_cheap_baselines_last() -> None:
    assert list(known_methods()) == ["default", "disco2004", "dipole", "lambertian"]
    assert [m.name for m in known_methods().values() if m.baseline] == ["dipole", "lambertian"]
    assert known_methods()["disco2004"].reads == "bilinear"
    assert all(m.about and m.colour for m in known_methods().values())


def test_a_new_file_is_a_new_method(room: Path) -> None:
    (room / "grey.py").write_text(MINE)
    assert known_methods()["grey"].colour == "#123456"
    assert ReconstructConfig.model_validate({"methods": ["grey"]}).methods == ("grey",)
    model = reconstruct(make(spots=40).samples, "grey")
    assert model.provenance == {"method": "grey"}
    assert [term.kind for term in model.terms] == ["lambertian"]


@pytest.mark.parametrize("mark", ["registry.method", "pipeline.reconstruct.registry.method"])
def test_the_decorator_may_be_named_through_its_module(mark: str, room: Path) -> None:
    (room / "grey.py").write_text(MINE.replace("@method", f"@{mark}"))
    assert known_methods()["grey"].about == "the mean albedo"


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('"grey"', '"dipole"', "registered in pipeline.reconstruct.baselines.dipole, too"),
        ('about="the mean albedo"', "about=text", "cannot be read, line 5"),
        ('colour="#123456"', 'reads="nearest"', "reads='nearest' is none of footprint, bilinear"),
        ('about="the mean albedo"', "shiny=True", "cannot be read"),
        ("def grey(samples):", "def grey(samples)", "is not valid Python.*line 6"),
        (', about="the mean albedo"', "", "line 5 .missing a required"),
        ('"grey"', "3", "line 5 .the name 3 is not of a-z"),
        ('"grey"', '"../grey"', "line 5 .the name '../grey' is not of a-z"),
        ('about="the mean albedo"', "about=3", "line 5 .about is text"),
        ('colour="#123456"', 'baseline="no"', "line 5 .about is text, baseline True or False"),
        ('colour="#123456"', "reads=[]", r"line 5 .reads=\[\] is none of"),
        ('colour="#123456"', 'colour="grey"', "line 5 .colour='grey' is not #rrggbb"),
        ('"grey", about="the mean albedo", colour="#123456"', '"grey", "the mean albedo"', "line 5 .too many"),
        ('("grey", about="the mean albedo", colour="#123456")', "", "line 5 .its arguments are missing"),
        ("mean", "m\xe9an", "is not valid Python.*utf-8"),
        ("mean", "m\0an", "is not valid Python.*null bytes"),
    ],
)
def test_a_file_that_declares_its_method_wrongly(old: str, new: str, expected: str, room: Path) -> None:
    (room / "grey.py").write_text(MINE.replace(old, new), encoding="latin-1")
    with pytest.raises(InputError, match=expected) as caught:
        known_methods()
    assert "grey.py" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_method_is_refused_with_the_nearest_and_all_names() -> None:
    for refuse in (
        lambda: require_method("diopole"),
        lambda: check({"methods": ["default", "diopole"]}, ReconstructConfig, "scene.toml"),
    ):
        with pytest.raises(InputError, match=r"methods.*'diopole'.*disco2004.*did you mean 'dipole'") as caught:
            refuse()
        assert "\n" not in str(caught.value)


def test_names_are_checked_without_heavy_imports() -> None:
    code = (
        "import sys; from pipeline.reconstruct.settings import ReconstructConfig\n"
        "ReconstructConfig(methods=('dipole',))\n"
        "print([name for name in ('scipy', 'trimesh', 'numpy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
