"""The page as one file: template, style, scripts, the block of data and a still picture; no network, no server."""

from __future__ import annotations

import base64
import html
import io
import re
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
from PIL import Image

from disco_twin.experiment.run_folder import RunFolder
from disco_twin.view.collect import bytes_of, collect
from hw.base.arrays import F32
from hw.base.errors import InputError
from hw.base.files import write_atomically
from pipeline.model.factorise import Truncation
from pipeline.model.relightable import RelightableModel

SCRIPTS = ("data", "surface", "light", "relight", "draw", "curve", "controls", "app")
STRICT = '"use strict";\n'
LARGEST_MB = 30.0  # a page that phones open
BASE64 = 4 / 3
STILL_HEIGHT = 480


def write_page(folder: RunFolder, path: Path, method: str | None = None, rank: int | None = None) -> float:
    """Write the page; its size in MB.

    Raises: InputError for a run that is unfinished or damaged, and for a page above LARGEST_MB.
    """

    def chosen(model: RelightableModel) -> Truncation:
        own = Truncation.of(len(model.mesh.vertices))
        cut = own if rank is None else replace(own, rank=min(rank, own.patch))
        require_small(model, cut, folder)
        return cut

    page = collect(folder, method, chosen)
    text = render(page.head["scene"], page.block.text(page.head), page.still)
    size = len(text.encode()) / 1e6
    write_atomically(path, text.encode())
    return size


def require_small(model: RelightableModel, cut: Truncation, folder: RunFolder) -> None:
    """Raises: InputError for factors of more than LARGEST_MB, with the largest rank that fits."""
    megabytes = BASE64 * bytes_of(model, cut) / 1e6
    if megabytes <= LARGEST_MB:
        return
    smaller = (replace(cut, rank=rank) for rank in range(cut.rank - 1, 0, -1))
    fitting = next((one.rank for one in smaller if BASE64 * bytes_of(model, one) / 1e6 <= LARGEST_MB), None)
    remedy = "a scan of fewer vertices" if fitting is None else f"--rank {fitting}"
    raise InputError(
        f"the page would have {megabytes:.0f} MB", file=folder.root, key="--rank", value=cut.rank,
        allowed=f"up to {LARGEST_MB:.0f} MB", remedy=remedy,
    )  # fmt: skip


def render(title: str, block: str, still: F32) -> str:
    """The page as HTML. still: (L, H, W) radiance."""
    files = resources.files("disco_twin.view") / "page"
    script = "\n".join((files / f"{name}.js").read_text(encoding="utf-8").replace(STRICT, "") for name in SCRIPTS)
    parts = {
        "@TITLE@": html.escape(title),
        "@STYLE@": (files / "page.css").read_text(encoding="utf-8"),
        "@STILL@": f"data:image/png;base64,{_png(still)}",
        "@SCRIPT@": STRICT + script,
        "@BLOCK@": block,
    }
    return re.sub(r"@[A-Z]+@", lambda mark: parts[mark[0]], (files / "page.html").read_text(encoding="utf-8"))


def _png(image: F32) -> str:
    """Base64 of a picture: the 99th percentile of what is lit to white, gamma 2.2, enlarged to be looked at."""
    lit = image[image > 0]
    white = float(np.percentile(lit, 99)) if lit.size else 1.0
    rgb = image if len(image) == 3 else np.repeat(image[:1], 3, axis=0)
    shown = np.clip(rgb / white, 0, 1).transpose(1, 2, 0) ** (1 / 2.2)
    height, width = image.shape[1:]
    scale = max(1, round(STILL_HEIGHT / height))
    picture = Image.fromarray(np.asarray(255 * shown + 0.5, np.uint8))
    buffer = io.BytesIO()
    picture.resize((width * scale, height * scale), Image.Resampling.BICUBIC).quantize(128).save(
        buffer, "PNG", optimize=True
    )
    return base64.b64encode(buffer.getvalue()).decode()
