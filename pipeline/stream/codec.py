"""The compression of one raw record, without loss.

Almost all that a record holds is noise, a few counts of it in the dark and more where there is light. Prediction only
adds the noise of the predictor, so what counts is to code every histogram as its own:

1. Charges are cut into runs of 32 pixels along the rows. A run's kind is the bit length of its largest less its
   smallest charge: runs of one kind are noise of like size, whatever the sensor's offset and gain.
2. The quiet runs, within 16 counts of each other, are most of an image: two pixels make a byte, whose histogram zstd
   codes (Huffman), several times as fast as anything that codes pixels one by one.
3. The runs of every other kind, in the order of the image, are coded by pcodec: adaptive bins, asymmetric numeral
   systems for the bin and plain bits within it. It also decides whether differences between neighbours are smaller.
   Large kinds are coded in pieces, so that cores can share an image.
4. Exponents are zero in most runs; those of the others are compressed by zstd, with the kinds.

Both libraries release Python's lock.
"""

from __future__ import annotations

from concurrent.futures import Executor
from typing import TypeVar

import numpy as np
import zstandard
from numpy.typing import NDArray
from pcodec import ChunkConfig, ModeSpec, standalone

from hw.base.arrays import I64, U8, U16
from hw.record import RawImage

Pixel = TypeVar("Pixel", np.uint8, np.uint16)

RUN = 32  # pixels
PIECE = 2048  # runs that are coded together at most
HALVED = np.uint8(128)  # added to a kind: the run has exponents other than zero
QUIET = 3  # bits of the largest range that counts as quiet
NIBBLE = 16  # counts
ZSTD_LEVEL = 1
# Level and what is tried were chosen by measurement (decision 0040); a decoder needs neither.
_PCO = ChunkConfig(compression_level=6, mode_spec=ModeSpec.classic())


def encode(raw: RawImage, pool: Executor | None = None) -> tuple[bytes, bytes]:
    """(exponents and kinds, charges), both compressed; the same bytes with and without a pool to share the work."""
    if raw.exponent.dtype != np.uint8 or raw.charge.dtype != np.uint16:
        raise ValueError(f"a record is uint8 and uint16, not {raw.exponent.dtype} and {raw.charge.dtype}")
    if raw.exponent.ndim != 2 or raw.exponent.shape != raw.charge.shape or not raw.exponent.size:
        raise ValueError(f"a record has two equal shapes (height, width), not {raw.exponent.shape}, {raw.charge.shape}")
    coding = map if pool is None else pool.map
    runs = _runs(raw.charge)
    kinds, base = _kinds(runs)
    sorted_runs = runs[_order(kinds)]
    quiet, pieces = _pieces(kinds)
    pieces_coded = coding(_encode_piece, [sorted_runs[piece] for piece in pieces])
    exponents = _runs(raw.exponent)
    words = exponents.view(np.uint64)
    halved = np.bitwise_or.reduce(list(words.T)) != 0
    described = (kinds | (halved * HALVED)).tobytes() + exponents[halved].tobytes()
    coded = [_encode_quiet(sorted_runs[quiet], base), *pieces_coded]
    lengths = np.array([base, *map(len, coded)], "<u4")
    return zstandard.compress(described, ZSTD_LEVEL), lengths.tobytes() + b"".join(coded)


def decode(shape: tuple[int, int], exponents: bytes, charges: bytes) -> RawImage:
    """The record of `shape` (height, width) from the two results of `encode`."""
    size = shape[0] * shape[1]
    described = np.frombuffer(zstandard.decompress(exponents), np.uint8)
    count = -(-size // RUN)
    kinds, halved = described[:count] & ~HALVED, described[:count] >= HALVED
    exponent = np.zeros((count, RUN), np.uint8)
    exponent[halved] = described[count:].reshape(-1, RUN)
    quiet, pieces = _pieces(kinds)
    base, *lengths = np.frombuffer(charges, "<u4", 2 + len(pieces)).tolist()
    start, end = 4 * (2 + len(pieces)), 4 * (2 + len(pieces)) + lengths[0]
    sorted_runs = np.empty((count, RUN), np.uint16)
    sorted_runs[quiet] = _decode_quiet(charges[start:end], base)
    for piece, length in zip(pieces, lengths[1:], strict=True):
        start, end = end, end + length
        standalone.simple_decompress_into(charges[start:end], sorted_runs[piece].reshape(-1))
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


def _kinds(runs: U16) -> tuple[U8, int]:
    """(n,) bit length of every run's range, at least QUIET; and the base of the quiet ones.

    A quiet run that does not lie between base and base + NIBBLE - 1 joins the next kind.
    """
    columns = np.ascontiguousarray(runs.T)  # four times as fast as reducing the short axis
    low, high = columns.min(axis=0), columns.max(axis=0)
    kinds = np.maximum(np.frexp((high - low).astype(np.float32))[1], QUIET).astype(np.uint8)
    quiet = np.flatnonzero(kinds == QUIET)
    usual = int(np.median(low[quiet])) if len(quiet) else 0
    base = max(usual - (NIBBLE - (1 << QUIET)) // 2, 0)
    kinds[quiet[(low[quiet] < base) | (high[quiet].astype(np.int32) >= base + NIBBLE)]] = QUIET + 1
    return kinds, base


def _order(kinds: U8) -> I64:
    """Indices that bring runs of one kind together and keep the image's order within."""
    return np.argsort(kinds, kind="stable")


def _pieces(kinds: U8) -> tuple[slice, list[slice]]:
    """Which of the sorted runs are quiet, and which others are coded together."""
    low, *others = np.bincount(kinds, minlength=QUIET + 1)[QUIET:].tolist()
    quiet, pieces = slice(0, low), []
    for count in others:
        for first in range(low, low + count, PIECE):
            pieces.append(slice(first, min(first + PIECE, low + count)))
        low += count
    return quiet, pieces


def _encode_piece(runs: U16) -> bytes:
    return bytes(standalone.simple_compress(runs.reshape(-1), _PCO))


def _encode_quiet(runs: U16, base: int) -> bytes:
    pixels = (runs - np.uint16(base)).reshape(-1)
    pairs = pixels[::2] | pixels[1::2] << np.uint16(4)
    return zstandard.compress(pairs.astype(np.uint8).tobytes(), ZSTD_LEVEL)


def _decode_quiet(coded: bytes, base: int) -> U16:
    pair = np.arange(256, dtype=np.uint16)
    both = np.stack([(pair & 15) + np.uint16(base), (pair >> 4) + np.uint16(base)], axis=1)
    # Pairs are looked up as one item of 4 bytes, whichever way round the machine stores them.
    pairs = both.view(np.uint32).reshape(-1).take(np.frombuffer(zstandard.decompress(coded), np.uint8))
    return pairs.view(np.uint16).reshape(-1, RUN)
