"""One frame of somebody else's camera as digital numbers; what is not one picture of raw numbers is refused."""

from __future__ import annotations

import hashlib
import warnings
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from hw.base.arrays import U16
from hw.base.errors import InputError

KINDS = "16-bit grey PNG or TIFF"
FORMATS = ("PNG", "TIFF")  # others are rescaled as they are read (PGM), or lose something (JPEG 2000)
MODES = ("I;16", "I;16B", "I;16L", "I")
PHOTOMETRIC = 262  # tag of TIFF; 0: numbers count down from white
ORIENTATION = 274  # tag of TIFF and EXIF: how a viewer should turn the picture; 1: not at all


def frame_digest(path: Path, where: str) -> str:
    """Digest of a file's bytes. where: the line that names it. Raises: InputError where it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, hashlib.blake2b).hexdigest()
    except FileNotFoundError as error:
        raise InputError(f"no such file ({where})", file=path, remedy="copy the frame there") from error
    except OSError as error:
        remedy = "make it readable, or correct the line"
        raise InputError(f"cannot be read: {error.strerror} ({where})", file=path, remedy=remedy) from error


def read_frame(path: Path, shape: tuple[int, int], full_scale_dn: int, where: str) -> U16:
    """(height, width) digital numbers of a 16-bit grey image of one page, its rows and columns as they are stored.

    Raises: InputError for anything else.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # Pillow reads a damaged file as far as it gets
            with Image.open(path) as image:
                mode, pages = image.mode, int(getattr(image, "n_frames", 1))
                kind, negative = str(image.format), getattr(image, "tag_v2", {}).get(PHOTOMETRIC) == 0
                turned = image.getexif().get(ORIENTATION, 1)
                pixels = np.asarray(image)
    except FileNotFoundError as error:
        raise InputError(f"no such file ({where})", file=path, remedy="copy the frame there") from error
    except (
        OSError,
        UnidentifiedImageError,
        SyntaxError,
        ValueError,
        EOFError,
        Warning,
        Image.DecompressionBombError,
    ) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"not a readable image ({reason})", file=path, remedy=f"save it as {KINDS}") from error
    if pages > 1:
        remedy = "save every page as a file of its own, a line each"
        raise InputError(f"holds {pages} pages ({where})", file=path, allowed="one", remedy=remedy)
    if kind not in FORMATS:
        remedy = "save the sensor's raw numbers without loss"
        raise InputError(f"is of another format ({where})", file=path, value=kind, allowed=KINDS, remedy=remedy)
    if negative:
        remedy = "save it with black as zero (PhotometricInterpretation 1)"
        raise InputError(f"counts down from white ({where})", file=path, key="PhotometricInterpretation", value=0,
                         allowed="1", remedy=remedy)  # fmt: skip
    if mode not in MODES:
        remedy = "save the sensor's raw numbers, not a picture for the screen"
        raise InputError("is not 16-bit grey", file=path, value=mode, allowed=KINDS, remedy=remedy)
    if turned != 1:
        raise InputError(
            f"is to be turned or mirrored for display ({where})", file=path, key="Orientation", value=turned,
            allowed="1", remedy="store rows and columns as the sensor read them, with the tag Orientation 1 or none",
        )  # fmt: skip
    if pixels.shape != shape:
        problem, remedy = f"has {pixels.shape[1]} x {pixels.shape[0]} pixels", "correct rig.cameras, or the frame"
        raise InputError(problem, file=path, allowed=f"the camera's {shape[1]} x {shape[0]}", remedy=remedy)
    if pixels.min() < 0 or pixels.max() > full_scale_dn:
        _refuse_range(path, pixels, full_scale_dn)
    return pixels.astype(np.uint16)


def _refuse_range(path: Path, pixels: np.ndarray, full_scale_dn: int) -> None:
    value = int(pixels.max() if pixels.max() > full_scale_dn else pixels.min())
    remedy = "correct sensor.bits, or shift the values down if the camera fills the upper bits"
    if pixels.min() >= 0 and pixels.max() <= 0xFFFF and pixels.astype(np.uint16).byteswap().max() <= full_scale_dn:
        if np.any(pixels & 0xFF):
            remedy = "exchange the two bytes of every number: they are stored the wrong way round"
    problem, allowed = "holds values beyond the sensor's", f"0 to {full_scale_dn}"
    raise InputError(problem, file=path, value=value, allowed=allowed, remedy=remedy)
