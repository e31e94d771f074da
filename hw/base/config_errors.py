"""What a schema refuses, in one line: key, value, what is allowed and the remedy, in the words of TOML."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from hw.base.errors import InputError

KINDS = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false"}
HOW = {
    "number": "write a number, without quotes",
    "integer": "write a whole number, without quotes or point",
    "string": "write a text in quotes",
    "boolean": "write true or false, without quotes",
}
SIGNS = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
BARE = re.compile(r"[A-Za-z0-9_-]+")


def one_line(error: ValidationError, data: dict[str, Any], schema: type[BaseModel], path: str | Path) -> InputError:
    """The first problem of a pydantic error. Unknown keys go before missing ones, as a typo causes both."""
    problem = min(error.errors(include_url=False), key=_rank)
    kind, location, context = problem["type"], problem["loc"], problem.get("ctx", {})
    root = schema.model_json_schema()
    key, value = _found(location, data, keep_last=kind == "missing")
    if kind == "extra_forbidden":
        *parent, name = location
        remedy = _nearest(str(name), _node(root, parent).get("properties", {}))
        return InputError("unknown key", file=path, key=_found(location, data)[0], remedy=remedy)
    node = _plain(root, _node(root, location))
    allowed, how = _allowed(root, node), _how(root, node, key)
    if kind == "missing" and location and isinstance(location[-1], int):
        key, _, _ = key.rpartition("[")
        return InputError(f"has {location[-1]} values", file=path, key=key, remedy="give one more")
    if kind == "missing":
        return InputError("required key is missing", file=path, key=key, allowed=allowed, remedy=f"add it: {how}")
    if kind == "union_tag_not_found":
        tags = ", ".join(node.get("discriminator", {}).get("mapping", {}))
        remedy = "add it"
        return InputError("required key is missing", file=path, key=f"{key}.kind", allowed=tags or None, remedy=remedy)
    if kind == "union_tag_invalid":
        given, tags = value.get("kind") if isinstance(value, dict) else value, context["expected_tags"].replace("'", "")
        remedy = _nearest(str(given), tags.split(", "))
        return InputError("unknown kind", file=path, key=f"{key}.kind", value=_scalar(given), allowed=tags,
                          remedy=remedy)  # fmt: skip
    message, remedy = _words(problem, value, node, how)
    return InputError(message, file=path, key=key or None, value=_scalar(value), allowed=allowed, remedy=remedy)


def _rank(problem: Any) -> int:
    """Of a union's members all report; a value out of range says more than `is not of the other member's type`.

    An array whose members are all refused is reported as too short, too: its members say more.
    """
    kind = problem["type"]
    if kind == "too_short" and isinstance(problem["input"], list | tuple) and problem["input"]:
        return 3
    return 0 if kind == "extra_forbidden" else 2 if kind.endswith("_type") else 1


def _words(problem: Any, value: Any, node: dict[str, Any], how: str) -> tuple[str, str]:
    """What is wrong, and the remedy."""
    kind = problem["type"]
    out = f", or leave the key out (it is {json.dumps(node['default'])} then)" if node.get("default") else ""
    if kind == "value_error":  # a rule of the schema's own, in its own words
        return problem["msg"].removeprefix("Value error, "), "correct it in this file"
    if kind in ("too_short", "too_long"):
        many = isinstance(value, list) and value and isinstance(value[0], dict)
        size = len(value) if isinstance(value, list) else 0
        return f"has {size} {'tables' if many else 'values'}", "give as many as are allowed"
    if kind == "string_too_short":
        return "is empty", f"{how}{out}"
    if kind == "string_too_long":
        return f"has {len(str(value))} characters", f"shorten it{out}"
    if kind == "string_pattern_mismatch":
        return "is no such text", f"correct it{out}"
    if kind == "literal_error":
        choices = node.get("enum", [])
        if choices and all(isinstance(choice, str) for choice in choices):
            how = _nearest(str(value)[:60], choices)
        elif choices:
            how = f"use one of {', '.join(map(str, choices))}"
        return "is no choice here", f"{how}{out}"
    if kind == "finite_number" or (isinstance(value, float) and not abs(value) < float("inf")):
        return "is no finite number", f"{how}{out}"
    if kind in ("greater_than", "greater_than_equal", "less_than", "less_than_equal", "int_parsing_size"):
        return "is out of range", f"choose a value in that range{out}"
    expected = KINDS.get(str(node.get("type")), "array" if node.get("type") == "array" else "table")
    return f"is {'neither' if expected == 'true or false' else 'no'} {expected.replace(' or ', ' nor ')}", f"{how}{out}"


def _scalar(value: Any) -> object:
    """A value as it is shown: no tables."""
    if isinstance(value, dict) or (isinstance(value, list) and any(isinstance(v, dict) for v in value)):
        return None
    return value


def _found(location: tuple[int | str, ...], data: Any, keep_last: bool = True) -> tuple[str, Any]:
    """`rig.cameras[1].name` and its value in the file; unions' tags in a pydantic location are no keys."""
    out = ""
    for i, part in enumerate(location):
        if isinstance(part, int):
            out += f"[{part}]"
            data = data[part] if isinstance(data, list | tuple) and part < len(data) else None
        elif isinstance(data, dict) and (part in data or (keep_last and i == len(location) - 1)):
            name = part if BARE.fullmatch(part) else json.dumps(part[:60], ensure_ascii=False)
            out += f".{name}" if out else name
            data = data.get(part)
    return out, data


def _nearest(name: str, valid: Iterable[str]) -> str:
    valid = list(valid)
    near = difflib.get_close_matches(name, valid, 1, cutoff=0.5)
    return f"did you mean {near[0]!r}?" if near else f"use one of {', '.join(valid)}"


# ---- the schema


def _follow(root: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    while "$ref" in node:
        node = {key: value for key, value in node.items() if key != "$ref"} | root["$defs"][node["$ref"].split("/")[-1]]
    return node


def _plain(root: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    """The node itself, or the first of its choices that is something."""
    options = [option for option in node.get("anyOf", []) if option.get("type") != "null"]
    inner = _follow(root, options[0]) if options else node
    return inner | ({"default": node["default"]} if "default" in node else {})


def _node(root: dict[str, Any], location: Iterable[int | str]) -> dict[str, Any]:
    """The part of a JSON schema that a pydantic location points to."""
    node = root
    for part in location:
        tagged = node.get("discriminator", {}).get("mapping", {})
        options = [_follow(root, option) for option in node.get("anyOf", [])] or [node]
        if part in tagged:
            node = _follow(root, {"$ref": tagged[part]})
        elif isinstance(part, int):
            arrays = [option for option in options if option.get("type") == "array"]
            fixed = arrays[0].get("prefixItems", []) if arrays else []
            node = _follow(root, fixed[part] if part < len(fixed) else arrays[0].get("items", {})) if arrays else {}
        else:
            inside = [option["properties"][part] for option in options if part in option.get("properties", {})]
            node = _follow(root, inside[0]) if inside else node  # otherwise the tag of a plain union
    return node


def _of_tables(root: dict[str, Any], node: dict[str, Any]) -> bool:
    item = _follow(root, node.get("items", {})) if isinstance(node.get("items", {}), dict) else {}
    return item.get("type") == "object" or "oneOf" in item


def _allowed(root: dict[str, Any], node: dict[str, Any]) -> str | None:
    """What a JSON schema's node allows, in words."""
    if "const" in node or "enum" in node:
        return ", ".join(map(str, node.get("enum", [node.get("const")])))
    if "description" in node and node.get("type") == "string":
        return str(node["description"])
    if node.get("type") == "array":
        what = "tables" if _of_tables(root, node) else "values"
        least, most = node.get("minItems"), node.get("maxItems")
        if least == most:
            return None if least is None else f"{least} {what}"
        return f"{least or 0} to {most} {what}" if most is not None else f"at least {least} {what}"
    words = [f"{sign} {node[key]:.12g}" for key, sign in SIGNS.items() if key in node]
    words += [f"pattern {node['pattern']}"] if "pattern" in node else []
    longest = f", at most {node['maxLength']} characters" if "maxLength" in node else ""
    kind = KINDS.get(str(node.get("type")))
    kind = kind if kind is None or kind == "true or false" else f"a {kind}"
    return " ".join(filter(None, [kind, " and ".join(words)])) + longest or None


def _how(root: dict[str, Any], node: dict[str, Any], key: str) -> str:
    """How such a value is written in TOML."""
    if "const" in node:
        return f"write {json.dumps(node['const'])}"
    if node.get("type") == "array":
        return f"write a table [[{key}]] for each" if _of_tables(root, node) else "write an array, as in [1, 2]"
    return HOW.get(str(node.get("type")), f"write a table [{key}] with its keys below it")
