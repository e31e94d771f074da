"""Configuration read from TOML: strict, with one-line errors that name file, key, value and remedy."""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError, ValidationInfo

from hw.errors import InputError


class Strict(BaseModel):
    """Base of every schema: unknown keys are refused, values are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


M = TypeVar("M", bound=Strict)


def _resolve(path: Path, info: ValidationInfo) -> Path:
    folder = (info.context or {}).get("folder")
    full = path if folder is None else Path(folder, path)
    if not full.is_file():
        raise ValueError(f"no such file: {full}")
    return full.resolve()


NearbyFile = Annotated[Path, AfterValidator(_resolve)]
"""A file that must exist; relative names are relative to the folder of the TOML file that names it."""


def load_toml(path: str | Path, schema: type[M]) -> M:
    """Read and validate a TOML file. Every failure is one `InputError` that names the first problem."""
    path = Path(path)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        near = difflib.get_close_matches(path.name, (p.name for p in path.parent.glob("*.toml")), 1)
        remedy = f"did you mean {path.parent / near[0]}?" if near else "give the path of a scene's TOML file"
        raise InputError("no such file", file=path, remedy=remedy) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", file=path) from error
    except UnicodeDecodeError as error:
        raise InputError(f"is not UTF-8 text (byte {error.start})", file=path, remedy="save it as UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"is not valid TOML: {error}", file=path) from error
    return check(data, schema, path)


def check(data: dict[str, Any], schema: type[M], path: str | Path) -> M:
    """Validate parsed TOML; `path` is the file it came from, for messages and relative file names."""
    try:
        return schema.model_validate(data, context={"folder": Path(path).resolve().parent})
    except ValidationError as error:
        raise _one_line(error, data, path) from None


def _one_line(error: ValidationError, data: dict[str, Any], path: str | Path) -> InputError:
    """The first problem of a pydantic error, an unknown key before a missing one: a typo causes both."""
    problems = error.errors(include_url=False)
    first = next((p for p in problems if p["type"] == "extra_forbidden"), problems[0])
    key = _dotted(first["loc"], data)
    remedy = None
    if first["type"] == "extra_forbidden":
        return InputError("unknown key", file=path, key=key, remedy=remedy)
    return InputError(first["msg"].removeprefix("Value error, "), file=path, key=key, value=first["input"])


def _dotted(location: tuple[int | str, ...], data: Any) -> str:
    """`rig.cameras[1].name` for the parts of a pydantic location that exist in the file (union tags do not)."""
    out = ""
    for i, part in enumerate(location):
        if isinstance(part, int):
            out += f"[{part}]"
            data = data[part] if isinstance(data, list | tuple) and part < len(data) else None
        elif isinstance(data, dict) and part not in data and i < len(location) - 1:
            continue  # the tag of a discriminated union
        else:
            out += f".{part}" if out else part
            data = data.get(part) if isinstance(data, dict) else None
    return out
