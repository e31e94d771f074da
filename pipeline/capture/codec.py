"""The compression of one raw record, without loss.

Almost all that a record holds is noise, a few counts of it in the dark and more where there is light. Prediction only
adds the noise of the predictor, so what counts is to code every histogram as its own:

1. Charges are cut into runs of 32 pixels along the rows. A run's kind is the bit length of its largest less its
   smallest charge: runs of one kind are noise of like size, whatever the sensor's offset and gain.
2. The runs of one kind, in the order of the image, are coded by pcodec: adaptive bins, asymmetric numeral systems for
   the bin and plain bits within it. It also decides whether differences between neighbours are smaller. Large kinds
   are coded in pieces, so that cores can share an image.
3. Exponents are zero in most runs; those of the others are compressed by zstd, with the kinds.

Both libraries release Python's lock.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from typing import TypeVar

import numpy as np
import zstandard
from numpy.typing import NDArray
from pcodec import ChunkConfig, DeltaSpec, ModeSpec, standalone

from hw.record import RawImage

U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
Pixel = TypeVar("Pixel", np.uint8, np.uint16)

RUN = 32  # pixels
PIECE = 2048  # runs that are coded together at most
HALVED = np.uint8(128)  # added to a kind: the run has exponents other than zero
QUIETEST = 3  # bits; telling still quieter runs apart would cost more than it saves
ZSTD_LEVEL = 1
# Levels and what is tried were chosen by measurement (decision 0040); a decoder needs neither.
_NOISE = ChunkConfig(compression_level=5, mode_spec=ModeSpec.classic(), delta_spec=DeltaSpec.no_op())
_SIGNAL = ChunkConfig(compression_level=6, mode_spec=ModeSpec.classic())


def encode(raw: RawImage, pool: Executor | None = None) -> tuple[bytes, bytes]:
    """(exponents and kinds, charges), both compressed; the same bytes with and without a pool to share the work."""
    if raw.exponent.dtype != np.uint8 or raw.charge.dtype != np.uint16:
        raise ValueError(f"a record is uint8 and uint16, not {raw.exponent.dtype} and {raw.charge.dtype}")
    if raw.exponent.ndim != 2 or raw.exponent.shape != raw.charge.shape or not raw.exponent.size:
        raise ValueError(f"a record has two equal shapes (height, width), not {raw.exponent.shape}, {raw.charge.shape}")
    coding = map if pool is None else pool.map
    runs = _runs(raw.charge)
    kinds = _kinds(runs)
    sorted_runs = runs[_order(kinds)]
    pieces = coding(_encode_piece, [(kind, sorted_runs[piece]) for kind, piece in _pieces(kinds)])
    exponents = _runs(raw.exponent)
    words = exponents.view(np.uint64)
    halved = np.bitwise_or.reduce(list(words.T)) != 0
    described = (kinds | (halved * HALVED)).tobytes() + exponents[halved].tobytes()
    coded = list(pieces)
    lengths = np.array([len(piece) for piece in coded], "<u4")
    return zstandard.compress(described, ZSTD_LEVEL), lengths.tobytes() + b"".join(coded)


def decode(shape: tuple[int, int], exponents: bytes, charges: bytes) -> RawImage:
    """The record of `shape` (height, width) from the two results of `encode`."""
    size = shape[0] * shape[1]
    described = np.frombuffer(zstandard.decompress(exponents), np.uint8)
    count = -(-size // RUN)
    kinds, halved = described[:count] & ~HALVED, described[:count] >= HALVED
    exponent = np.zeros((count, RUN), np.uint8)
    exponent[halved] = described[count:].reshape(-1, RUN)
    pieces = [piece for _, piece in _pieces(kinds)]
    ends = 4 * len(pieces) + np.cumsum(np.frombuffer(charges, "<u4", len(pieces)), dtype=np.int64)
    sorted_runs = np.empty((len(kinds), RUN), np.uint16)
    start = 4 * len(pieces)
    for piece, end in zip(pieces, ends.tolist(), strict=True):
        standalone.simple_decompress_into(charges[start:end], sorted_runs[piece].reshape(-1))
        start = end
    order = _order(kinds)
    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    charge = sorted_runs.take(back, axis=0).reshape(-1)[:size]
    return RawImage(exponent.reshape(-1)[:size].reshape(shape), charge.reshape(shape))


def _runs(image: NDArray[Pixel]) -> NDArray[Pixel]:
    """(n, RUN): the image's pixels row after row; the last one is repeated to fill the last run."""
    flat = np.ascontiguousarray(image).reshape(-1)
    missing = -flat.size % RUN
    return (np.pad(flat, (0, missing), mode="edge") if missing else flat).reshape(-1, RUN)


def _kinds(runs: U16) -> U8:
    """(n,) bit length of every run's range, at least QUIETEST."""
    columns = np.ascontiguousarray(runs.T)  # four times as fast as reducing the short axis
    bits = np.frexp((columns.max(axis=0) - columns.min(axis=0)).astype(np.float32))[1]
    return np.asarray(np.maximum(bits, QUIETEST), np.uint8)


def _order(kinds: U8) -> NDArray[np.int64]:
    """Indices that bring runs of one kind together and keep the image's order within."""
    return np.argsort(kinds, kind="stable")


def _pieces(kinds: U8) -> Iterator[tuple[int, slice]]:
    """(kind, which of the sorted runs) are coded together, in order."""
    low = 0
    for kind, count in enumerate(np.bincount(kinds).tolist()):
        for first in range(low, low + count, PIECE):
            yield kind, slice(first, min(first + PIECE, low + count))
        low += count


def _encode_piece(piece: tuple[int, U16]) -> bytes:
    kind, runs = piece
    return bytes(standalone.simple_compress(runs.reshape(-1), _NOISE if kind == QUIETEST else _SIGNAL))
