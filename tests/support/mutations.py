"""Data with a few values exchanged, keys left out and added: what files hold after a slip, or by another program."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Iterator
from typing import Any

from hypothesis import strategies as st

STRANGE: list[Any] = [
    0, 1, -1, 2, 7, 2**31, 2**63 - 1, 0.0, -0.0, 0.5, 1.0, -1.0, 1e-300, 1e-9, 1e9, 1e300, math.inf, -math.inf,
    math.nan,
    True, False, "", "x", "nan", "1", "../x", "a/b", "\n", "é", "x" * 300, [], [[]], [0.0, 0.0, 0.0], [1e300] * 3,
    {}, {"kind": "x"},
]  # fmt: skip


def places(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of every value in tables and lists."""
    inside = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in inside:
        yield (*path, key)
        yield from places(value, (*path, key))


@st.composite
def mutated(draw: st.DrawFn, data: Any, most: int = 2) -> Any:
    """A copy with up to `most` changes."""
    out = copy.deepcopy(data)
    for _ in range(draw(st.integers(1, most))):
        *parents, last = draw(st.sampled_from(list(places(out))))
        table = out
        for key in parents:
            table = table[key]
        kind = draw(
            st.sampled_from(
                ["strange", "strange", "nudged", "nudged", "nudged", "scaled", "left out", "added", "again"]
            )
        )
        value = table[last]
        if kind == "left out":
            del table[last]
        elif kind == "added" and isinstance(table, dict):
            key = draw(st.sampled_from(["extra", "name", "kind", "Name"]))
            table[key] = copy.deepcopy(draw(st.sampled_from(STRANGE)))
        elif kind == "again" and isinstance(table, list):
            table.append(copy.deepcopy(value))
        elif kind == "nudged" and isinstance(value, int) and not isinstance(value, bool):
            table[last] = value + draw(st.integers(-1, 2))
        elif kind == "nudged" and isinstance(value, float):
            table[last] = value * draw(st.floats(0.9, 1.1))
        elif kind == "scaled" and isinstance(value, int | float) and not isinstance(value, bool):
            table[last] = value * draw(st.sampled_from([-1.0, 1e-6, 1e-3, 1e3, 1e6, 1.5]))
        elif kind == "nudged" and isinstance(value, str) and value:
            table[last] = value[::-1]
        else:
            table[last] = copy.deepcopy(draw(st.sampled_from(STRANGE)))
        if not list(places(out)):
            break
    return out


def toml(data: dict[str, Any]) -> str:
    """A table as TOML, all but its first level in inline tables."""
    return "".join(f"{json.dumps(key)} = {_value(value)}\n" for key, value in data.items())


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_value(v)}" for key, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return "nan" if math.isnan(value) else f"{'-' if value < 0 else ''}inf" if math.isinf(value) else repr(value)
    return json.dumps(value) if isinstance(value, str) else str(value)
