"""The base of what the walk reads and adds to."""

from __future__ import annotations

from typing import Any


class Opaque:
    """Arrays that the walk reads or adds to. Not a dataclass: Dr.Jit would carry its fields through every loop."""

    def __init__(self, **fields: Any) -> None:
        if set(fields) != set(type(self).__annotations__):
            raise TypeError(f"{type(self).__name__} takes {sorted(type(self).__annotations__)}")
        self.__dict__.update(fields)
