"""Configuration read from TOML: strict, with one-line errors that name file, key, value and remedy."""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    model_validator,
)

from hw.base.config_errors import one_line
from hw.base.errors import InputError


class Strict(BaseModel):
    """Base of every schema: unknown keys are refused, values are immutable, `true` is no number and "3" neither."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    @model_validator(mode="before")
    @classmethod
    def _arrays(cls, data: Any) -> Any:
        """TOML's arrays are lists, ours are tuples."""
        if not isinstance(data, dict):
            return data
        return {key: str(v) if cls._no_choice(key, v) else _tuples(v) for key, v in data.items()}

    @classmethod
    def _no_choice(cls, key: str, value: Any) -> bool:
        """Whether `true` or `1.0` stands where a whole number is one of a few: to Python both equal 1."""
        field = cls.model_fields.get(key)
        choices = get_args(field.annotation) if field and get_origin(field.annotation) is Literal else ()
        return isinstance(value, bool | float) and value in choices and type(value) not in map(type, choices)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list | tuple) else value


T = TypeVar("T")


def as_table(kind: type[Any]) -> BeforeValidator:
    """Annotation of a field that is a standard dataclass: it may be given as a table of its fields."""
    adapter = TypeAdapter(kind)
    return BeforeValidator(lambda data: adapter.validate_python(data) if isinstance(data, dict) else data)


M = TypeVar("M", bound=Strict)


def _resolve(path: Path, info: ValidationInfo) -> Path:
    folder = (info.context or {}).get("folder")
    full = path if folder is None else Path(folder, path)
    if not full.is_file():
        raise ValueError(f"no such file: {full}")
    return full.resolve()


NearbyFile = Annotated[Path, Field(strict=False), AfterValidator(_resolve)]
"""A file that must exist; relative names are relative to the folder of the TOML file that names it."""


def load_toml(
    path: str | Path, schema: type[M], what: str = "a scene's TOML file", others: Mapping[str, str] | None = None
) -> M:
    """Read and validate a TOML file. Raises: InputError for every failure; it names the first problem.

    what: the kind of file, in words for the remedy where another one was given; others: a table of another kind of
    file, and what that file is called
    """
    path = Path(path)
    remedy = f"give the path of {what}"
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):  # reading it may wait for ever
            raise InputError("is a device or a pipe, not a file", file=path, remedy=remedy)
        data = tomllib.loads(path.read_bytes().decode("utf-8-sig").replace("\r\n", "\n"))
    except FileNotFoundError:
        near = difflib.get_close_matches(path.name, (p.name for p in path.parent.glob("*.toml")), 1)
        remedy = f"did you mean {path.parent / near[0]}?" if near else remedy
        raise InputError("no such file", file=path, remedy=remedy) from None
    except IsADirectoryError as error:
        raise InputError("is a folder, not a file", file=path, remedy=remedy) from error
    except PermissionError as error:
        remedy = f"allow yourself to read it, or {remedy}"
        raise InputError("cannot be read: permission denied", file=path, remedy=remedy) from error
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", file=path, remedy=remedy) from error
    except UnicodeDecodeError as error:
        remedy = f"save it as UTF-8, or {remedy}"
        raise InputError(f"is not UTF-8 text (byte {error.start})", file=path, remedy=remedy) from error
    except RecursionError as error:
        raise InputError("is nested too deeply", file=path, remedy="mend the brackets") from error
    except ValueError as error:  # tomllib's own, and a number of thousands of digits
        remedy = "mend that line; texts stand in quotes, a table's name in brackets, a key once"
        raise InputError(f"is not valid TOML: {error}", file=path, remedy=remedy) from error
    if not data:
        raise InputError("is empty: it has no key", file=path, remedy=f"write it, or {remedy}")
    for table, kind in (others or {}).items():
        if table in data:
            raise InputError(f"is {kind}", file=path, remedy=f"give the path of {what}")
    for key, number in _numbers(data):
        if not -(2**63) <= number < 2**63:
            remedy = "write fewer digits"
            raise InputError("is no TOML", file=path, key=key, value=number, allowed="64 bits", remedy=remedy)
    return check(data, schema, path)


def _numbers(data: Any, key: str = "") -> Iterator[tuple[str, int]]:
    """Every whole number with its key."""
    if isinstance(data, dict):
        for name, value in data.items():
            yield from _numbers(value, f"{key}.{name}" if key else name)
    elif isinstance(data, list):
        for place, value in enumerate(data):
            yield from _numbers(value, f"{key}[{place}]")
    elif isinstance(data, int):
        yield key, data


def read_json(path: Path, schema: type[T], remedy: str) -> T:
    """Read and validate a JSON file that a program wrote; file names inside it are relative to its folder.

    Raises: InputError for any failure or another version.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        return TypeAdapter(schema).validate_python(data, context={"folder": path.resolve().parent})
    except FileNotFoundError as error:
        raise InputError("is missing", file=path, remedy=remedy.removeprefix("delete it, then ")) from error
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", file=path, remedy=remedy) from error
    except ValidationError as error:
        first = min(error.errors(), key=lambda e: e["loc"][:1] != ("format_version",))
        key = ".".join(str(part) for part in first["loc"]) or None
        value = first["input"] if isinstance(first["input"], str | int | float) else None
        if key == "format_version":
            allowed = str(first.get("ctx", {}).get("expected", "")) or None
            problem = "another format"
            raise InputError(problem, file=path, key=key, value=value, allowed=allowed, remedy=remedy) from error
        message = f"is damaged ({first['msg'].removeprefix('Value error, ')})"
        raise InputError(message, file=path, key=key, value=value, remedy=remedy) from error
    except (ValueError, RecursionError) as error:
        raise InputError("is damaged (it is no JSON)", file=path, remedy=remedy) from error


def in_words(error: Exception) -> str:
    """What an error of a library says, in one line; of a schema's, the first problem alone."""
    if isinstance(error, ValidationError):
        first = error.errors(include_url=False)[0]
        return ": ".join([*(str(part) for part in first["loc"]), first["msg"].removeprefix("Value error, ")])
    return " ".join(str(error).split())


def check(data: dict[str, Any], schema: type[M], path: str | Path) -> M:
    """Validate parsed TOML; `path` is the file it came from, for messages and relative file names."""
    try:
        return schema.model_validate(data, context={"folder": Path(path).resolve().parent})
    except ValidationError as error:
        raise one_line(error, data, schema, path) from None
