"""Reference images: the object under other light, traced through the same medium, never through eq. 2.1.

Two independent halves per image let a score remove the reference's noise without bias; light from below the surface
and light reflected at it are separate layers, since R_d answers for the first alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hw.base.arrays import F32
from hw.base.errors import InputError
from hw.base.files import replacing, require_version
from pipeline.geometry.camera import PinholeCamera
from pipeline.relight.lights import Light

if TYPE_CHECKING:
    from disco_twin.light.transport import Transport


FORMAT_VERSION = 1
RENDER_AGAIN = "delete it, disco-twin run renders it again"
LAYERS = ("subsurface", "surface")
HALVES = ("A", "B")


@dataclass(frozen=True)
class Reference:
    """One light seen by one camera.

    halves: (2, 2, L, H, W) float32 radiance (half, layer, laser, row, column) in W/(mm^2 sr);
    walks: photons in each half; key: hash of all that the image depends on.
    """

    halves: F32
    walks: int
    key: str


def render_reference(
    transport: Transport, light: Light, cameras: Sequence[PinholeCamera], walks: int, seed: int, key: str = ""
) -> list[Reference]:
    """Trace one light towards all cameras at once; `walks` is the number of photons in both halves together."""
    from disco_twin.light.sources import light_source  # what is stored can be read without a renderer

    half = max(1, walks // 2)
    traced = transport.trace(
        lambda group: light_source(light, transport.radius, group), 2, half, seed=seed, cameras=cameras, layers=2
    )
    assert traced.images is not None
    return [Reference(traced.images[:, :, c], half, key) for c in range(len(cameras))]


def save_reference(path: Path, reference: Reference) -> None:
    """Replace one EXR of half floats, channels `<layer>.<half>.<laser>`, scaled so that the brightest value is 6e4:
    half floats then resolve light that is ten decades fainter.
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
        "walks": str(reference.walks),
        "key": reference.key,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        OpenEXR.File(header, channels).write(file.name)


def load_reference(path: Path) -> Reference:
    """Read what `save_reference` wrote. Raises: InputError for a missing or damaged file, and for another format."""
    import OpenEXR

    if not path.is_file():
        raise InputError("the reference is missing", file=path, remedy="disco-twin run renders it")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            header, channels = dict(file.header()), {name: c.pixels for name, c in file.channels().items()}
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError("not a readable EXR", file=path, remedy=RENDER_AGAIN) from error
    require_version(path, header.get("formatVersion"), FORMAT_VERSION, RENDER_AGAIN)
    lasers = len(channels) // (len(HALVES) * len(LAYERS))
    names = [[[f"{layer}.{half}.{k}" for k in range(lasers)] for layer in LAYERS] for half in HALVES]
    halves = np.array([[[channels[name] for name in row] for row in rows] for rows in names])
    scale = float(header["radianceScale"])
    return Reference(halves.astype(np.float32) * scale, int(header["walks"]), str(header["key"]))
