"""Prisms over polygons, and what programs write of them: PLY, OBJ and STL in their many forms."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence

import numpy as np

from hw.base.arrays import F64

Polygon = Sequence[int]
Solid = tuple[F64, list[Polygon]]  # (V, 3) vertices, faces of any number of corners, counter-clockwise from outside

L = np.array([[0, 0], [30, 0], [30, 10], [10, 10], [10, 30], [0, 30]], float)  # 500 mm^2, 120 mm around


def prism(outline: F64, height: float = 20.0, turn: F64 | None = None) -> Solid:
    """Over an (N, 2) outline, counter-clockwise: two ends of N corners each, N quadrilaterals around."""
    n = len(outline)
    low, high = np.column_stack([outline, np.zeros(n)]), np.column_stack([outline, np.full(n, height)])
    vertices = np.concatenate([low, high]) @ (np.eye(3) if turn is None else turn).T
    around = [(i, (i + 1) % n, n + (i + 1) % n, n + i) for i in range(n)]
    return vertices.astype(np.float32).astype(np.float64), [[*range(n)][::-1], [*range(n, 2 * n)], *around]


def ply_ascii(solid: Solid, length: str = "uchar", index: str = "int") -> bytes:
    vertices, polygons = solid
    head = _ply_header(solid, "ascii", length, index)
    lines = [" ".join(f"{x:.17g}" for x in v) + " 7 0.5" for v in vertices]
    lines += ["3 1 2 3 " + " ".join(map(str, (len(p), *p))) + " 9" for p in polygons]
    return head + "\n".join(lines).encode() + b"\n"


def ply_binary(
    solid: Solid, order: str = "<", length: str = "uchar", index: str = "int", newline: bytes = b"\n"
) -> bytes:
    vertices, polygons = solid
    codes = {"uchar": "B", "char": "b", "short": "h", "ushort": "H", "int": "i", "uint": "I"}
    name = "binary_little_endian" if order == "<" else "binary_big_endian"
    body = b"".join(struct.pack(f"{order}3fBd", *v, 7, 0.5) for v in vertices)
    for p in polygons:
        body += struct.pack(f"{order}B3h", 3, 1, 2, 3)
        body += struct.pack(f"{order}{codes[length]}{len(p)}{codes[index]}i", len(p), *p, 9)
    return _ply_header(solid, name, length, index).replace(b"\n", newline) + body


def _ply_header(solid: Solid, kind: str, length: str, index: str) -> bytes:
    """With properties and elements that a reader has to read over, and a comment in Latin-1."""
    vertices, polygons = solid
    return (
        f"ply\nformat {kind} 1.0\ncomment texture Gem\xe4lde.png\nobj_info scanned\nelement camera 0\n"
        f"property float view\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\n"
        "property float z\nproperty uchar red\nproperty double quality\n"
        f"element face {len(polygons)}\nproperty list uchar short texnumber\n"
        f"property list {length} {index} vertex_indices\nproperty int flags\nend_header\n"
    ).encode("latin-1")


def obj(solid: Solid, corner: Callable[[int, int], str] = lambda v, _: str(v + 1), newline: str = "\n") -> bytes:
    """corner: how a corner is written, of a vertex's number and how many there are."""
    vertices, polygons = solid
    lines = ["# \xfcber", "mtllib gone.mtl", "o one"]
    lines += ["v\t" + " ".join(f"{x:.17g}" for x in v) + " 0.2 0.4 0.6" for v in vertices]
    lines += ["vt 0 0", "vn 0 0 1", "g side", "usemtl none", "s off"]
    for k, p in enumerate(polygons):
        lines += [f"g part{k}", "f " + "  ".join(corner(v, len(vertices)) for v in p) + "  # end"]
    return (newline.join(lines) + newline).encode("latin-1")


def stl_ascii(triangles: F64) -> bytes:
    """(F, 3, 3) corners."""
    lines = ["solid a vertex of many"]
    for t in triangles:
        lines += ["  facet normal 0 0 0", "    outer loop"]
        lines += ["      vertex " + " ".join(f"{x:.17g}" for x in corner) for corner in t]
        lines += ["    endloop", "  endfacet"]
    return "\r\n".join([*lines, "endsolid"]).encode()


def stl_binary(triangles: F64, head: bytes = b"solid trap") -> bytes:
    """(F, 3, 3) corners."""
    facets = b"".join(struct.pack("<12fH", 0, 0, 0, *t.ravel(), 3) for t in triangles)
    return head.ljust(80, b"\0") + struct.pack("<I", len(triangles)) + facets
