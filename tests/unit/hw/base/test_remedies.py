"""Every refusal says what helps."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from pydantic import ValidationError, field_validator

from hw.base.children import ROOT
from hw.base.config import Strict, in_words

WITHOUT = (
    "pipeline/geometry/mesh_file.py",  # `load_mesh` adds one
    "pipeline/geometry/mesh_formats.py",
)


@pytest.mark.parametrize("room", ["hw", "pipeline", "disco_twin"])
def test_every_input_error_names_a_remedy(room: str) -> None:
    silent = []
    for path in sorted(Path(ROOT, room).rglob("*.py")):
        name = str(path.relative_to(ROOT))
        for node in ast.walk(ast.parse(path.read_text())):
            own = isinstance(node, ast.Call) and getattr(node.func, "id", None) == "InputError"
            if own and not {k.arg for k in node.keywords} & {"remedy", None}:  # type: ignore[attr-defined]
                silent.append(f"{name}:{node.lineno}")  # type: ignore[attr-defined]
    assert [place for place in silent if place.partition(":")[0] not in WITHOUT] == []


def test_what_a_schema_says_is_one_line_in_its_own_words() -> None:
    class Even(Strict):
        number: int

        @field_validator("number")
        @classmethod
        def _even(cls, number: int) -> int:
            if number % 2:
                raise ValueError("is odd")
            return number

    with pytest.raises(ValidationError) as caught:
        Even(number=3)
    assert in_words(caught.value) == "number: is odd"
    assert in_words(ValueError("two\nlines")) == "two lines"
