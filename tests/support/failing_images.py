"""A failing image test leaves its images: what was found, the reference, and their difference."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

FOLDER = Path(__file__).resolve().parents[2] / "out" / "failing-images"


@contextmanager
def images_on_failure(name: str, image: ArrayLike, reference: ArrayLike, folder: Path = FOLDER) -> Iterator[None]:
    """Where an assertion of the block fails, write (L, H, W) images as PNG and name their folder in the message.

    image, reference: exposed so that the reference's 99th percentile is white, gamma 2.2; difference: grey where they
    agree, lighter where the image is too bright, full scale at half of that exposure.
    """
    try:
        yield
    except AssertionError as error:
        found, wanted = (_rgb(np.asarray(x, np.float64)) for x in (image, reference))
        white = max(float(np.percentile(wanted, 99)), 1e-30)
        folder = folder / name.replace("/", "-").replace(" ", "-")
        folder.mkdir(parents=True, exist_ok=True)
        shown = {"image": (found / white) ** (1 / 2.2), "reference": (wanted / white) ** (1 / 2.2)}
        for kind, values in (shown | {"difference": 0.5 + (found - wanted) / white}).items():
            pixels = np.round(255 * np.clip(np.nan_to_num(values), 0, 1)).astype(np.uint8)
            Image.fromarray(pixels).save(folder / f"{kind}.png")
        error.add_note(f"image, reference and difference are in {folder}")
        raise


def _rgb(image: np.ndarray) -> np.ndarray:
    """(L, H, W) -> (H, W, 3), three lasers as they are, else their mean; nothing negative."""
    channels = image if len(image) == 3 else np.repeat(image.mean(axis=0, keepdims=True), 3, axis=0)
    return np.maximum(np.moveaxis(channels, 0, 2), 0.0)
