"""Configuration read from TOML: strict, with one-line errors that name file, key, value and remedy."""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, TypeVar

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

from hw.errors import InputError


class Strict(BaseModel):
    """Base of every schema: unknown keys are refused, values are immutable, `true` is no number and "3" neither."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    @model_validator(mode="before")
    @classmethod
    def _arrays(cls, data: Any) -> Any:
        """TOML's arrays are lists, ours are tuples."""
        if not isinstance(data, dict):
            return data
        version = data.get("format_version", 1)
        if type(version) is not int:  # Python's True and 1.0 equal 1
            data = data | {"format_version": str(version)}
        return {key: _tuples(value) for key, value in data.items()}


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
        remedy = "give the path of a scene's TOML file"
        raise InputError(f"cannot be read: {error.strerror}", file=path, remedy=remedy) from error
    except UnicodeDecodeError as error:
        raise InputError(f"is not UTF-8 text (byte {error.start})", file=path, remedy="save it as UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        remedy = "mend that line; texts stand in quotes, a table's name in brackets"
        raise InputError(f"is not valid TOML: {error}", file=path, remedy=remedy) from error
    except RecursionError as error:
        raise InputError("is nested too deeply", file=path, remedy="mend the brackets") from error
    return check(data, schema, path)


def read_json(path: Path, schema: type[T], remedy: str) -> T:
    """Read and validate a JSON file that a program wrote; any failure, another format version too, is one line."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        return TypeAdapter(schema).validate_python(data)
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


def check(data: dict[str, Any], schema: type[M], path: str | Path) -> M:
    """Validate parsed TOML; `path` is the file it came from, for messages and relative file names."""
    try:
        return schema.model_validate(data, context={"folder": Path(path).resolve().parent})
    except ValidationError as error:
        raise _one_line(error, data, schema, path) from None


def _one_line(error: ValidationError, data: dict[str, Any], schema: type[Strict], path: str | Path) -> InputError:
    """The first problem of a pydantic error. Unknown keys go before missing ones, as a typo causes both."""
    problem = min(error.errors(include_url=False), key=lambda p: _rank(p["type"]))
    kind, location, context = problem["type"], problem["loc"], problem.get("ctx", {})
    key = _dotted(location, data, keep_last=kind == "missing")
    if kind == "extra_forbidden":
        *parent, name = location
        node = _node(schema.model_json_schema(), parent)
        remedy = _nearest(str(name), node.get("properties", {}))
        return InputError("unknown key", file=path, key=_dotted(location, data), remedy=remedy)
    if kind == "missing":
        if location and isinstance(location[-1], int):
            key, _, _ = key.rpartition("[")
            return InputError(f"has {location[-1]} values", file=path, key=key, remedy="give one more")
        return InputError("required key is missing", file=path, key=key, remedy="add it")
    if kind == "union_tag_not_found":
        node = _node(schema.model_json_schema(), location)
        tags = ", ".join(node.get("discriminator", {}).get("mapping", {}))
        remedy = "add it"
        return InputError("required key is missing", file=path, key=f"{key}.kind", allowed=tags or None, remedy=remedy)
    if kind == "union_tag_invalid":
        tag, tags = context["tag"], context["expected_tags"].replace("'", "")
        remedy = _nearest(tag, tags.split(", "))
        return InputError("unknown kind", file=path, key=f"{key}.kind", value=tag, allowed=tags, remedy=remedy)
    value = problem["input"] if isinstance(problem["input"], str | int | float | bool | list | tuple) else None
    allowed = _allowed(_node(schema.model_json_schema(), location))
    message = problem["msg"].removeprefix("Value error, ").replace("a valid tuple", "an array")
    if message.startswith("Input should"):
        message = "i" + message[1:]
    return InputError(message, file=path, key=key or None, value=value, allowed=allowed)


def _rank(kind: str) -> int:
    """Of a union's members all report; a value out of range says more than `is not of the other member's type`."""
    return 0 if kind == "extra_forbidden" else 2 if kind.endswith("_type") else 1


def _dotted(location: tuple[int | str, ...], data: Any, keep_last: bool = True) -> str:
    """`rig.cameras[1].name` from a pydantic location, without the parts that are tags of unions."""
    out = ""
    for i, part in enumerate(location):
        if isinstance(part, int):
            out += f"[{part}]"
            data = data[part] if isinstance(data, list | tuple) and part < len(data) else None
        elif isinstance(data, dict) and (part in data or (keep_last and i == len(location) - 1)):
            out += f".{part}" if out else part
            data = data.get(part)
    return out


def _nearest(name: str, valid: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, valid, 1, cutoff=0.5)
    return f"did you mean {near[0]!r}?" if near else f"use one of {', '.join(valid)}"


def _node(root: dict[str, Any], location: Iterable[int | str]) -> dict[str, Any]:
    """The part of a JSON schema that a pydantic location points to."""

    def follow(node: dict[str, Any]) -> dict[str, Any]:
        while "$ref" in node:
            node = root["$defs"][node["$ref"].rsplit("/", 1)[1]]
        return node

    node = root
    for part in location:
        tagged = node.get("discriminator", {}).get("mapping", {})
        options = [follow(option) for option in node.get("anyOf", [])] or [node]
        if part in tagged:
            node = follow({"$ref": tagged[part]})
        elif isinstance(part, int):
            arrays = [option for option in options if option.get("type") == "array"]
            fixed = arrays[0].get("prefixItems", []) if arrays else []
            node = follow(fixed[part] if part < len(fixed) else arrays[0].get("items", {})) if arrays else {}
        else:
            inside = [option["properties"][part] for option in options if part in option.get("properties", {})]
            node = follow(inside[0]) if inside else node  # otherwise the tag of a plain union
    return node


def _allowed(node: dict[str, Any]) -> str | None:
    """The range that a JSON schema's node states, in words."""
    node = next((option for option in node.get("anyOf", []) if option.get("type") != "null"), node)
    signs = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
    words = [f"{sign} {node[key]:g}" for key, sign in signs.items() if key in node]
    words += [f"at {bound} {node[key]} values" for key, bound in _LENGTHS.items() if key in node]
    if "enum" in node:
        words.append(", ".join(map(str, node["enum"])))
    if "pattern" in node:
        words.append(f"pattern {node['pattern']}")
    return " and ".join(words) or None


_LENGTHS = {"minItems": "least", "maxItems": "most"}
