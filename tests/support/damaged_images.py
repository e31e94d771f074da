"""Which images of a stream cannot be read back."""

from __future__ import annotations

from pipeline.stream.stream import CorruptImage, StreamReader


def damaged_images(stream: StreamReader) -> list[int]:
    """Their indices; every image is read and decoded."""
    return [image.index for image in stream if isinstance(image, CorruptImage)]
