"""Reference images as they are kept: the object under other light, never through eq. 2.1 (rendering.py makes them).

Two independent halves per image let a score remove the reference's noise without bias; light from below the surface
and light reflected at it are separate layers, since R_d answers for the first alone.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hw.base.arrays import F32
from hw.base.errors import InputError
from hw.base.files import replacing, require_version

FORMAT_VERSION = 2
RENDER_AGAIN = "delete it, disco-twin run renders it again"
LAYERS = ("subsurface", "surface")
HALVES = ("A", "B")


@dataclass(frozen=True)
class Reference:
    """One light seen by one camera.

    halves: (2, 2, L, H, W) float32 radiance (half, layer, laser, row, column) in W/(mm^2 sr);
    noise: that it was rendered for, see `noise_of`; key: hash of all that the image depends on.
    """

    halves: F32
    noise: float
    key: str


def noise_of(halves: F32) -> float:
    """Noise over the image: the deviation of the mean of both halves as a share of its root mean square, all lasers
    together, of light from below the surface. halves: (2, 2, L, H, W); 0 for a black image, infinite in the dark.
    """
    a, b = halves[:, LAYERS.index("subsurface")].astype(np.float64)
    noise, signal = float(((a - b) ** 2).sum()) / 4, float((a * b).sum())
    return math.sqrt(noise / signal) if signal > 0 else (math.inf if noise else 0.0)


def save_reference(path: Path, reference: Reference) -> None:
    """Replace one EXR of half floats, channels `<layer>.<half>.<laser>`, scaled so that the brightest value is 6e4:
    half floats then resolve light that is ten decades fainter. Raises: OSError where the disk refuses.
    """
    import OpenEXR

    scale = (float(reference.halves.max()) or 1.0) / 6e4
    channels = {
        f"{layer}.{half}.{laser}": np.ascontiguousarray(reference.halves[h, k, laser] / scale).astype(np.float16)
        for h, half in enumerate(HALVES)
        for k, layer in enumerate(LAYERS)
        for laser in range(reference.halves.shape[2])
    }
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "formatVersion": FORMAT_VERSION,
        "radianceScale": scale,
        "noise": str(reference.noise),
        "key": reference.key,
        "pixels": _digest(channels),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        OpenEXR.File(header, channels).write(file.name)


def _digest(channels: Mapping[str, NDArray[np.generic]]) -> str:
    """Of all pixels: programs that change them may keep what they do not know, key and noise among it."""
    digest = hashlib.blake2b(digest_size=16)
    for name in sorted(channels):
        digest.update(name.encode() + np.ascontiguousarray(channels[name]).tobytes())
    return digest.hexdigest()


def load_reference(path: Path) -> Reference:
    """Read what `save_reference` wrote; files of before have no digest of their pixels.

    Raises: InputError for a missing, damaged or changed file, and for another format.
    """
    import OpenEXR

    if not path.is_file():
        raise InputError("the reference is missing", file=path, remedy="disco-twin run renders it")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            header, channels = dict(file.header()), {name: c.pixels for name, c in file.channels().items()}
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError("not a readable EXR", file=path, remedy=RENDER_AGAIN) from error
    require_version(path, header.get("formatVersion"), FORMAT_VERSION, RENDER_AGAIN)
    if "pixels" in header and header["pixels"] != _digest(channels):
        raise InputError("was changed by another program since it was rendered", file=path, remedy=RENDER_AGAIN)
    lasers = len(channels) // (len(HALVES) * len(LAYERS))
    names = [[[f"{layer}.{half}.{k}" for k in range(lasers)] for layer in LAYERS] for half in HALVES]
    halves = np.array([[[channels[name] for name in row] for row in rows] for rows in names])
    scale = float(header["radianceScale"])
    return Reference(halves.astype(np.float32) * scale, float(header["noise"]), str(header["key"]))
