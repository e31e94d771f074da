"""The registry of methods. A method is one function from samples to a model, in one file of this package:

    @method("mine", about="what it does, in one line")
    def reconstruct_mine(samples: Samples) -> RelightableModel:

The decorators are read from the files without running them, so that a scene's methods can be checked before anything
heavy is imported; a method's module is imported when it is called.
"""

from __future__ import annotations

import ast
import difflib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import pipeline.reconstruct
from hw.base.errors import InputError

READS = ("footprint", "bilinear")

Function = TypeVar("Function", bound=Callable[..., Any])


@dataclass(frozen=True)
class Method:
    """name: in scenes, files and reports; about: one line; reads: how vertices are read from images, `footprint` or
    `bilinear` (`samples.image_operators`); baseline: cheap, and scored in every run; colour: in plots, #rrggbb;
    module, function: where it is
    """

    name: str
    module: str
    function: str
    about: str = ""
    reads: str = "footprint"
    baseline: bool = False
    colour: str | None = None

    def load(self) -> Callable[..., Any]:
        """The function, from its module."""
        return getattr(import_module(self.module), self.function)  # type: ignore[no-any-return]


def method(
    name: str, *, about: str, reads: str = "footprint", baseline: bool = False, colour: str | None = None
) -> Callable[[Function], Function]:
    """Register a function as a method (see `Method`). The arguments are written out: `known_methods` reads them."""
    return lambda function: function


@cache
def known_methods() -> Mapping[str, Method]:
    """All methods of the package by name, the default first.

    Raises: InputError for a file that is not valid Python, a decorator whose arguments are not written out, or a name
    that is taken.
    """
    found: dict[str, Method] = {}
    for module, file in _modules():
        text = file.read_text(encoding="utf-8")
        if "@method(" in text:
            for one in _declared(module, file, text):
                if one.name in found:
                    raise InputError(
                        f"the method is registered in {found[one.name].module}, too", file=file, key="@method",
                        value=one.name, remedy="give it another name",
                    )  # fmt: skip
                found[one.name] = one
    return dict(sorted(found.items(), key=lambda item: (item[0] != "default", item[1].baseline, item[0])))


def _modules() -> Iterable[tuple[str, Path]]:
    """Names and files of the package's modules, in its rooms, too; but this one."""
    for root in map(Path, pipeline.reconstruct.__path__):
        for file in sorted(root.rglob("*.py")):
            if file != Path(__file__):
                yield ".".join(["pipeline.reconstruct", *file.relative_to(root).with_suffix("").parts]), file


def _declared(module: str, file: Path, text: str) -> Iterable[Method]:
    try:
        tree = ast.parse(text)
    except SyntaxError as error:
        raise InputError(
            f"is not valid Python, line {error.lineno} ({error.msg})", file=file, remedy="correct it"
        ) from error
    for node in tree.body:
        for mark in node.decorator_list if isinstance(node, ast.FunctionDef) else ():
            if isinstance(mark, ast.Call) and isinstance(mark.func, ast.Name) and mark.func.id == "method":
                assert isinstance(node, ast.FunctionDef)
                try:
                    (name,) = map(ast.literal_eval, mark.args)
                    options = {word.arg or "**": ast.literal_eval(word.value) for word in mark.keywords}
                    declared = Method(name, module, node.name, **options)
                    if declared.reads not in READS:
                        raise ValueError(f"reads={declared.reads!r} is none of {', '.join(READS)}")
                    yield declared
                except (ValueError, TypeError) as error:
                    raise InputError(
                        f"cannot be read, line {mark.lineno} ({error})", file=file, key="@method",
                        remedy='write it as @method("name", about="one line", reads="footprint", baseline=False)',
                    ) from error  # fmt: skip


def require_method(name: str) -> str:
    """The name of a known method. Raises: InputError with the nearest and all names."""
    known = known_methods()
    if name not in known:
        near = difflib.get_close_matches(name, known, 1, cutoff=0.5)
        raise InputError(
            "unknown method", key="methods", value=name, allowed=", ".join(known),
            remedy=f"did you mean {near[0]!r}?" if near else "choose from these",
        )  # fmt: skip
    return name
