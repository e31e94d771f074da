"""PLY, OBJ and STL: bytes -> vertices and polygons, as programs write them in the wild.

Own readers, since the polygons' corners are needed as they stand in the file: docs/decisions/0107-mesh-files.md. Text
is taken as bytes: names and comments may be in any encoding.

PLY: ascii, binary of either byte order; elements and properties that are not needed are read over.
OBJ: all objects, groups and materials together; relative numbers, line continuations; texture and normals are left out.
STL: ascii (several solids, too), binary, also where it begins with "solid".
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hw.base.arrays import F64, I64
from hw.base.errors import InputError

PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
BYTE_ORDER = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
MOST_VERTICES = 1 << 40  # more than any file holds, and far from what an index can be
STL_HEAD, STL_FACET = 84, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
STL_VERTEX = re.compile(rb"^[ \t]*vertex[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)[ \t]*\r?$", re.I | re.M)


@dataclass(frozen=True)
class Polygons:
    """vertices: (V, 3) in the file's unit; corners: (C,) vertex numbers, polygon after polygon; sizes: (P,) corners."""

    vertices: F64
    corners: I64
    sizes: I64


@dataclass(frozen=True)
class Column:
    """A property of a PLY element. length: the type of a list's length; None for a single value."""

    name: str
    type: str
    length: str | None


@dataclass(frozen=True)
class Lists:
    """A column of lists: (C,) items, list after list; (N,) sizes."""

    items: NDArray[Any]
    sizes: I64


# ---------------------------------------------------------------- PLY
def read_ply(data: bytes) -> Polygons:
    """The element `face` and the positions of the element `vertex`. Raises: InputError."""
    byte_order, elements, body = _ply_header(data)
    source = _Ascii(body) if byte_order == "=" else _Binary(body, byte_order)
    found: dict[str, dict[str, NDArray[Any] | Lists]] = {}
    for name, count, columns in elements:
        found[name] = source.element(name, count, columns)
        if {"vertex", "face"} <= found.keys():
            break
    vertex, face = found.get("vertex", {}), found.get("face", {})
    if any(axis not in vertex or isinstance(vertex[axis], Lists) for axis in "xyz"):
        raise InputError("the mesh is empty (no vertices with x, y and z)")
    vertices = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    lists = face.get("vertex_indices", face.get("vertex_index"))
    if not isinstance(lists, Lists):
        raise InputError("the mesh is empty (only points, no faces)")
    return Polygons(vertices, _whole(lists.items), lists.sizes)


def _ply_header(data: bytes) -> tuple[str, list[tuple[str, int, list[Column]]], bytes]:
    """Byte order, elements as (name, count, properties), and what follows the header."""
    end = re.search(rb"^end_header[ \t]*(\r\n|\n|\r)", data, re.M) or re.search(rb"\rend_header[ \t]*\r", data)
    if end is None:
        raise InputError("its header does not end")
    byte_order, elements = "", list[tuple[str, int, list[Column]]]()
    for line in data[: end.start()].splitlines():
        words = line.decode("latin-1").split()
        try:
            match words:
                case ["format", kind, "1.0"]:
                    byte_order = BYTE_ORDER[kind]
                case ["element", name, count] if count.isdecimal():
                    elements.append((name, int(count), []))
                case ["property", "list", length, of, name]:
                    if PLY_TYPES[length].startswith("f"):
                        raise ValueError("a list's length is no fraction")
                    elements[-1][2].append(Column(name, PLY_TYPES[of], PLY_TYPES[length]))
                case ["property", of, name]:
                    elements[-1][2].append(Column(name, PLY_TYPES[of], None))
        except (KeyError, ValueError, IndexError) as error:
            raise InputError(f"its header cannot be read at {' '.join(words)!r}") from error
    if not byte_order:
        raise InputError("its header names no known format")
    return byte_order, elements, data[end.end() :]


class _Binary:
    """Elements one after the other from a binary body."""

    def __init__(self, body: bytes, byte_order: str) -> None:
        self.body, self.byte_order, self.at = body, byte_order, 0

    def element(self, name: str, count: int, columns: list[Column]) -> dict[str, NDArray[Any] | Lists]:
        if not count or not columns:
            return {}
        try:
            return self._equal_rows(count, columns) or self._rows(count, columns)
        except (struct.error, ValueError) as error:
            raise InputError(f"the file ends before its {count} elements {name!r}") from error

    def _equal_rows(self, count: int, columns: list[Column]) -> dict[str, NDArray[Any] | Lists]:
        """All rows at once, where all lists of a column are as long as the first; nothing where they are not."""
        sizes, at = {}, self.at
        for c in columns:
            if c.length is not None:
                (sizes[c.name],) = np.frombuffer(self.body, self.byte_order + c.length, 1, at).tolist()
                at += int(c.length[1])
            at += int(c.type[1]) * int(sizes.get(c.name, 1))
        fields: list[Any] = []
        for c in columns:
            if c.length is not None:
                fields.append((f"length of {c.name}", self.byte_order + c.length))
            shape = (int(sizes[c.name]),) if c.length is not None else ()
            fields.append((c.name, self.byte_order + c.type, shape))
        row = np.dtype(fields)
        if self.at + count * row.itemsize > len(self.body):
            return {}
        rows = np.frombuffer(self.body, row, count, self.at)
        if any((rows[f"length of {name}"] != size).any() for name, size in sizes.items()):
            return {}
        self.at += count * row.itemsize
        return {
            c.name: rows[c.name] if c.length is None else Lists(rows[c.name].ravel(), np.full(count, sizes[c.name]))
            for c in columns
        }

    def _rows(self, count: int, columns: list[Column]) -> dict[str, NDArray[Any] | Lists]:
        single: dict[str, list[Any]] = {c.name: [] for c in columns}
        sizes: dict[str, list[int]] = {c.name: [] for c in columns}
        codes = {kind: np.dtype(kind).char for kind in PLY_TYPES.values()}
        at = self.at
        for _ in range(count):
            for c in columns:
                many = 1
                if c.length is not None:
                    (many,) = struct.unpack_from(self.byte_order + codes[c.length], self.body, at)
                    at += int(c.length[1])
                    sizes[c.name].append(int(many))
                single[c.name] += struct.unpack_from(f"{self.byte_order}{int(many)}{codes[c.type]}", self.body, at)
                at += int(c.type[1]) * int(many)
        self.at = at
        return _columns(columns, single, sizes)


class _Ascii:
    """Elements one after the other from words."""

    def __init__(self, body: bytes) -> None:
        self.words, self.at = body.split(), 0

    def element(self, name: str, count: int, columns: list[Column]) -> dict[str, NDArray[Any] | Lists]:
        single: dict[str, list[Any]] = {c.name: [] for c in columns}
        sizes: dict[str, list[int]] = {c.name: [] for c in columns}
        words, at = self.words, self.at
        try:
            if all(c.length is None for c in columns):
                values = np.array(list(map(float, words[at : at + count * len(columns)])))
                table = values.reshape(count, len(columns))
                self.at += count * len(columns)
                return {c.name: _typed(table[:, k], c.type) for k, c in enumerate(columns)}
            for _ in range(count):
                for c in columns:
                    many = 1
                    if c.length is not None:
                        many = int(words[at])
                        at += 1
                        sizes[c.name].append(many)
                    if many < 0 or at + many > len(words):
                        raise IndexError
                    single[c.name] += map(float, words[at : at + many])
                    at += many
        except IndexError as error:
            raise InputError(f"the file ends before its {count} elements {name!r}") from error
        except ValueError as error:
            whole = self.at + count * len(columns) <= len(words)
            problem = f"its elements {name!r} are not all numbers"
            raise InputError(problem if whole else f"the file ends before its {count} elements {name!r}") from error
        self.at = at
        return _columns(columns, single, sizes)


def _columns(
    columns: list[Column], single: dict[str, list[Any]], sizes: dict[str, list[int]]
) -> dict[str, NDArray[Any] | Lists]:
    values = {c.name: _typed(np.array(single[c.name], np.float64), c.type) for c in columns}
    return {
        c.name: values[c.name] if c.length is None else Lists(values[c.name], np.array(sizes[c.name], np.int64))
        for c in columns
    }


def _typed(values: F64, kind: str) -> F64:
    """As a binary file would hold it: 0.1 in a property of type float is float32's 0.1."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32).astype(np.float64) if kind == "f4" else values


def _whole(numbers: NDArray[Any]) -> I64:
    """Vertex numbers. Raises: InputError for fractions."""
    with np.errstate(invalid="ignore"):
        whole = numbers.astype(np.int64)
    if (whole != numbers).any():
        raise InputError("a face names a vertex by a fraction")
    return whole


# ---------------------------------------------------------------- OBJ
def read_obj(data: bytes) -> Polygons:
    """All `v` and `f` lines. A vertex's weight or colour, behind its position, is left out. Raises: InputError."""
    vertices, corners, sizes = list[list[float]](), list[int](), list[int]()
    if b"\\" in data:
        data = re.sub(rb"\\[ \t]*(\r\n|\n|\r)", b" ", data)
    for number, line in enumerate(data.splitlines(), start=1):
        words = line.partition(b"#")[0].split()
        if not words or words[0] not in (b"v", b"f"):
            continue
        try:
            if words[0] == b"v":
                x, y, z = words[1:4]
                vertices.append([float(x), float(y), float(z)])
                continue
            polygon = [int(word.partition(b"/")[0]) for word in words[1:]]
        except ValueError as error:
            raise InputError(f"line {number} cannot be read: {line.decode('latin-1').strip()[:60]!r}") from error
        if 0 in polygon or min(polygon, default=0) < -len(vertices) or max(polygon, default=0) > MOST_VERTICES:
            raise InputError(f"line {number}: a triangle names a vertex that does not exist")
        corners += [v - 1 if v > 0 else len(vertices) + v for v in polygon]  # from the vertices read so far
        sizes.append(len(polygon))
    points = np.array(vertices, np.float64).reshape(-1, 3)
    return Polygons(points, np.array(corners, np.int64), np.array(sizes, np.int64))


# ---------------------------------------------------------------- STL
def read_stl(data: bytes) -> Polygons:
    """Every triangle with three vertices of its own. Raises: InputError."""
    facets = int.from_bytes(data[STL_HEAD - 4 : STL_HEAD], "little")
    needed = STL_HEAD + facets * STL_FACET.itemsize
    text = data.lstrip()[:5].lower() == b"solid" and (STL_VERTEX.search(data) is not None or len(data) < STL_HEAD)
    if text and len(data) != needed:
        found = STL_VERTEX.findall(data)
        if len(found) % 3 or b"endsolid" not in data[-1024:].lower():
            raise InputError(f"the file ends after {len(found) // 3} triangles, without 'endsolid'")
        try:
            vertices = np.array([[float(x) for x in vertex] for vertex in found]).reshape(-1, 3)
        except ValueError as error:
            raise InputError("a vertex is not three numbers") from error
    elif len(data) < needed or len(data) < STL_HEAD:
        inside = max(0, len(data) - STL_HEAD) // STL_FACET.itemsize
        raise InputError(f"the file ends after {inside} of {facets} triangles" if len(data) > STL_HEAD else "is no STL")
    else:  # programs add bytes behind the triangles
        vertices = np.frombuffer(data, STL_FACET, facets, STL_HEAD)["corners"].reshape(-1, 3).astype(np.float64)
    return Polygons(vertices, np.arange(len(vertices)), np.full(len(vertices) // 3, 3))
