"""Arrays for the page: one block of bytes, gzipped, in base64. `page/data.js` reads it."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

LARGEST_HALF = 32768.0
KINDS = {"f4": np.float32, "u4": np.uint32, "u2": np.uint16}


class Block:
    """Arrays by name, each as one of the kinds that the page reads; `head` is any JSON that goes with them."""

    def __init__(self) -> None:
        self._entries: dict[str, dict[str, Any]] = {}
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, name: str, values: ArrayLike, kind: str, scale: float = 1.0) -> None:
        """Keep an array as f4, u4, u2, or f2 (half precision, `half` scales it)."""
        dtype = np.float16 if kind == "f2" else KINDS[kind]
        data = np.ascontiguousarray(values, np.dtype(dtype).newbyteorder("<"))
        self._entries[name] = {"kind": kind, "shape": data.shape, "at": self._size, "scale": scale}
        raw = data.tobytes()
        raw += bytes(-len(raw) % 4)
        self._parts.append(raw)
        self._size += len(raw)

    def half(self, name: str, values: ArrayLike) -> None:
        """Keep an array in half precision, scaled so that its largest number is half's largest: three digits, and
        nothing lost above 1e-9 of the largest.
        """
        data = np.asarray(values, np.float64)
        scale = max(float(np.abs(data).max(initial=0.0)), 1e-300) / LARGEST_HALF
        self.add(name, data / scale, "f2", scale)

    def packed(self, head: Mapping[str, Any]) -> bytes:
        """Everything, unzipped: length of the head, the head as JSON, the arrays."""
        shift = 0
        while True:  # offsets stand in the head, whose length shifts them
            entries = {name: entry | {"at": entry["at"] + shift} for name, entry in self._entries.items()}
            text = json.dumps({**head, "arrays": entries}, allow_nan=False, separators=(",", ":")).encode()
            text += b" " * (-len(text) % 4)
            if shift == 4 + len(text):
                return len(text).to_bytes(4, "little") + text + b"".join(self._parts)
            shift = 4 + len(text)

    def text(self, head: Mapping[str, Any]) -> str:
        """For the page. The same content, the same text."""
        return base64.b64encode(gzip.compress(self.packed(head), 9, mtime=0)).decode()


def ordered_pairs(pair: NDArray[np.int64], vertices: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.int64]]:
    """(V,) number of pairs by their first vertex, (N,) their second ones in that order, and (N,) that order."""
    order = np.lexsort((pair[1], pair[0]))
    return np.bincount(pair[0], minlength=vertices), pair[1][order], order
