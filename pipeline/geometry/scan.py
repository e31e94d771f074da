"""The scan's file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from hw.base.errors import InputError


def read_scan(path: Path) -> trimesh.Trimesh:
    """The scanned mesh in mm, vertices as they are numbered in the file.

    Raises: InputError where it cannot be read, or is not a closed surface oriented outward.
    """
    again = "delete it, then repeat the capture command"
    try:
        mesh = trimesh.load(path, process=False)
    except Exception as error:  # the loaders raise whatever their parsing trips over
        why = f" ({error.strerror})" if isinstance(error, OSError) and error.strerror else ""
        raise InputError(f"not a readable mesh{why}", file=path, remedy=again) from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError("holds no triangles", file=path, remedy=again)
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices) or not np.isfinite(mesh.vertices).all():
        raise InputError("the scan's triangles and vertices do not fit", file=path, remedy=again)
    if not mesh.is_watertight or mesh.volume <= 0:
        raise InputError("the scan is open or inside out", file=path, remedy="close it and orient its faces outward")
    return mesh
