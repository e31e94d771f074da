"""Voxel files: NumPy's `.npy` and Mitsuba's `.vol`."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hw.base.arrays import F32, F64, Bool
from hw.base.errors import InputError


@dataclass(frozen=True)
class Voxels:
    """values: (C, nz, ny, nx) float32, C = 1 or one channel a laser; low, high: (3,) x, y, z corners or None."""

    values: F32
    low: F64 | None
    high: F64 | None


def read_voxels(path: Path, lasers: int, key: str, highest: float = np.inf, lowest: float = 0.0) -> Voxels:
    """Read and check a grid: finite, `lowest` .. `highest`, one channel or one a laser.

    Raises: InputError for any other.
    """
    if path.suffix == ".npy":
        voxels = _read_npy(path, key)
    elif path.suffix == ".vol":
        voxels = _read_vol(path, key)
    else:
        raise InputError("unknown type of grid file", file=path, key=key, allowed=".npy or .vol", remedy=_NPY)
    values = voxels.values
    if values.size == 0:
        raise InputError("the grid is empty", file=path, key=key, remedy=_NPY)
    if len(values) not in (1, lasers):
        problem = f"the grid has {len(values)} wavelengths for {lasers} lasers"
        remedy = "store (nz, ny, nx) for all lasers, or (lasers, nz, ny, nx)"
        raise InputError(problem, file=path, key=key, remedy=remedy)
    too_low = "too small" if lowest else "negative"
    for bad, what in ((~np.isfinite(values), "not a finite number"), (values < lowest, too_low)):
        if bad.any():
            problem = f"{_first(bad)} is {what} ({bad.sum()} in all)"
            raise InputError(problem, file=path, key=key, allowed=f">= {lowest:g}", remedy=_CELL)
    if values.max() > highest:
        problem = f"{_first(values > highest)} is too large, the largest is {values.max():g}"
        raise InputError(problem, file=path, key=key, allowed=f"{lowest:g} .. {highest:g}", remedy=_CELL)
    return voxels


_NPY = "write it with numpy.save as float32 (nz, ny, nx)"
_CELL = "mend these voxels, or fill them with their neighbours' mean"
_VOL = "write it again, or give an .npy file with low_mm and high_mm"


def _first(bad: Bool) -> str:
    channel, z, y, x = (int(i) for i in np.argwhere(bad)[0])
    return f"voxel z={z} y={y} x={x} of channel {channel}"


def _read_npy(path: Path, key: str) -> Voxels:
    try:
        values = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError, SyntaxError, MemoryError) as error:
        why = f" ({error.strerror})" if isinstance(error, OSError) and error.strerror else ""
        raise InputError(f"not a readable .npy file of numbers{why}", file=path, key=key, remedy=_NPY) from error
    if not isinstance(values, np.ndarray) or values.ndim not in (3, 4) or values.dtype.kind not in "fiu":
        problem = "not an array of real numbers (nz, ny, nx) or (lasers, nz, ny, nx)"
        raise InputError(problem, file=path, key=key, remedy=_NPY)
    values = values.astype(np.float32)
    return Voxels(values if values.ndim == 4 else values[None], None, None)


def _read_vol(path: Path, key: str) -> Voxels:
    """Mitsuba's grid volume, version 3: header of 48 bytes, then float32 with channels fastest, then x, y, z."""
    data = path.read_bytes()
    if len(data) < 48 or data[:3] != b"VOL" or data[3] != 3:
        raise InputError("not a Mitsuba .vol file of version 3", file=path, key=key, remedy=_VOL)
    encoding, nx, ny, nz, channels = struct.unpack_from("<5i", data, 4)
    corners = np.array(struct.unpack_from("<6f", data, 24), dtype=float)
    if encoding != 1:
        problem = f"the .vol file's encoding is {encoding}"
        raise InputError(problem, file=path, key=key, allowed="1 (float32)", remedy=_VOL)
    count = nx * ny * nz * channels
    if min(nx, ny, nz, channels) < 1 or len(data) != 48 + 4 * count:
        problem = f"the .vol file has {len(data)} bytes, its header states {48 + 4 * count}"
        raise InputError(problem, file=path, key=key, remedy=_VOL)
    if not (np.isfinite(corners).all() and (corners[:3] < corners[3:]).all()):
        problem = f"the .vol file's corners are {corners[:3].tolist()} and {corners[3:].tolist()}"
        raise InputError(problem, file=path, key=key, allowed="finite, the first below the second", remedy=_VOL)
    values = np.frombuffer(data, "<f4", count, 48).reshape(nz, ny, nx, channels)
    return Voxels(np.moveaxis(values, -1, 0).astype(np.float32), corners[:3], corners[3:])
