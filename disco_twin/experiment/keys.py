"""Keys: digests of all that a result depends on, the code that makes it included."""

from __future__ import annotations

import hashlib
import json
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hw.base.errors import InputError

if TYPE_CHECKING:
    from grimp import ImportGraph

    from disco_twin.scene.scene import Scene

FLOORS = ("hw", "pipeline", "disco_twin")
RENDERER = ("mitsuba", "drjit", "numpy", "scipy")  # packages whose versions simulated light depends on


def content_key(*parts: Any) -> str:
    """SHA-256 over the parts: bytes, files (their content), text (marked by "="), or what JSON can hold, files too."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Path | bytes):
            data = part.read_bytes() if isinstance(part, Path) else part
        else:
            text = f"={part}" if isinstance(part, str) else json.dumps(part, sort_keys=True, default=content_key)
            data = text.encode()
        digest.update(len(data).to_bytes(8, "little"))
        digest.update(data)
    return digest.hexdigest()


def identity(scene: Scene) -> str:
    """Key of all that a capture and its ground truth depend on; how they are used, and how noisy references may be,
    may change within a run folder.
    """
    parts = {"format_version", "name", "seed", "object", "scan", "rig", "simulation"}
    return content_key(scene.model_dump(include=parts, exclude={"simulation": {"reference_noise"}}))


@cache
def code_key(*modules: str) -> str:
    """Key of the source of these modules and of all that they import (see `import_closure`); of light, its `RENDERER`.

    Raises: InputError where a file of the project is no valid Python.
    """
    closure = import_closure(*modules)
    versions = {name: _version(name) for name in RENDERER if "disco_twin.light" in closure}
    return content_key(*(part for module in closure for part in (module, _source(module))), versions)


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:  # a machine without the renderer
        return None


def import_closure(*modules: str) -> list[str]:
    """The project's modules that these import at whatever depth, themselves included, in alphabetical order.

    A package stands for all that it holds. Imports inside functions count, those for type checking alone do not; with
    a module come the packages that it lies in, which Python runs first. Raises: InputError, see `code_key`.
    """
    graph, found = _imports(), set[str]()
    fresh = {part for module in modules for part in (module, *graph.find_descendants(module))}
    while fresh:
        found |= fresh
        imported = {name for module in fresh for name in graph.find_modules_directly_imported_by(module)}
        fresh = imported.union(module.rpartition(".")[0] for module in fresh if "." in module) - found
    return sorted(found)


@cache
def _imports() -> ImportGraph:
    from grimp import build_graph
    from grimp.exceptions import SourceSyntaxError

    try:
        return build_graph(*FLOORS, exclude_type_checking_imports=True, cache_dir=None)
    except SourceSyntaxError as error:
        remedy = "mend it: a stage is done again when code that it imports has changed"
        raise InputError(f"is no valid Python: {error.text}", file=error.filename, remedy=remedy) from error


def _source(module: str) -> Path:
    floor, *rest = module.split(".")
    spec = find_spec(floor)
    assert spec is not None and spec.submodule_search_locations is not None
    path = Path(spec.submodule_search_locations[0], *rest)
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
