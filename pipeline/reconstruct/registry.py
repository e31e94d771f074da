"""The registry of methods. A method is one function from samples to a model, in one file of this package:

    @method("mine", about="what it does, in one line")
    def reconstruct_mine(samples: Samples) -> RelightableModel:

The decorators are read from the files without running them, so that a scene's methods can be checked before anything
heavy is imported; a method's module is imported when it is called.
"""

from __future__ import annotations

import ast
import difflib
import inspect
import re
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
    about: str
    reads: str
    baseline: bool
    colour: str | None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not re.fullmatch("[a-z0-9_-]+", self.name):
            raise ValueError(f"the name {self.name!r} is not of a-z, 0-9, _ and -: files are named after it")
        if not isinstance(self.about, str) or not isinstance(self.baseline, bool):
            raise ValueError("about is text, baseline True or False")
        if self.reads not in READS:
            raise ValueError(f"reads={self.reads!r} is none of {', '.join(READS)}")
        if self.colour is not None and not re.fullmatch("#[0-9a-fA-F]{6}", str(self.colour)):
            raise ValueError(f"colour={self.colour!r} is not #rrggbb")

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

    Raises: InputError for a file that is not valid Python, a decorator whose arguments are wrong or not written out, or
    a name that is taken.
    """
    found: dict[str, Method] = {}
    for module, file in _modules():
        text = file.read_bytes()
        if re.search(rb"^@.*\bmethod\b", text, re.MULTILINE):
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


def _declared(module: str, file: Path, text: bytes) -> Iterable[Method]:
    try:
        tree = ast.parse(text, file.name)
    except (SyntaxError, ValueError) as error:  # ValueError: null bytes
        raise InputError(f"is not valid Python: {error}", file=file, remedy="correct it") from error
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    for node in functions:
        for mark in node.decorator_list:
            called = mark.func if isinstance(mark, ast.Call) else mark
            if "method" not in (getattr(called, "id", None), getattr(called, "attr", None)):
                continue
            try:
                if not isinstance(mark, ast.Call):
                    raise ValueError("its arguments are missing")
                options = {word.arg or "**": ast.literal_eval(word.value) for word in mark.keywords}
                given = inspect.signature(method).bind(*map(ast.literal_eval, mark.args), **options)
                given.apply_defaults()
                yield Method(module=module, function=node.name, **given.arguments)
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
