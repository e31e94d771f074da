"""z-scores of one rendered image against another of the same light and view, block by block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from hw.base.arrays import F64

BLOCK = 8  # pixels


@dataclass(frozen=True)
class BlockZ:
    """z-scores of our image against an outside one.

    blocks: (L, N) of the sums over blocks of `BLOCK` x `BLOCK` pixels, by Student's t: the normal score of the same
        probability; whole: (L,) of the sum over the image
    ratio, ratio_se: (L,) ours over theirs, of the whole image, and its standard error
    """

    blocks: F64
    whole: F64
    ratio: F64
    ratio_se: F64


def z_of_blocks(ours: NDArray[np.floating], theirs: NDArray[np.floating]) -> BlockZ:
    """Compare two images in independent halves, (2, L, H, W) each. Blocks in which both are black are left out.

    The variance of a block's sum comes from the pixels' differences (A - B) / 2 in it. Pixels of a camera-side image
    are independent; a photon of ours may reach several, which raises the variance of sums by a factor that is
    estimated over all blocks of the image together. A block that few pixels tell of, or a few bright ones, has few
    degrees of freedom: n equal ones have 3 (sum v)^2 / sum v^2 - 2 = n of them, v the squared differences of normal
    noise, in the mean.
    """
    (mean, own), (outside, other) = (by_block(np.asarray(halves, np.float64)) for halves in (ours, theirs))
    squares = np.concatenate([shared(own)[:, None, None] * own**2, other**2], axis=-1)
    variance = squares.sum(axis=-1)
    lit = (variance > 0).all(axis=0)
    off, variance, fourth = (mean - outside)[:, lit], variance[:, lit], (squares**2).sum(axis=-1)[:, lit]
    t, freedom = off / np.sqrt(variance), np.maximum(3 * variance**2 / fourth - 2, 1.0)
    z = np.sign(t) * stats.norm.isf(stats.t.sf(np.abs(t), freedom))
    total, error, difference = outside[:, lit].sum(axis=1), np.sqrt(variance.sum(axis=1)), off.sum(axis=1)
    return BlockZ(z, difference / error, 1 + difference / total, error / total)


def by_block(halves: F64) -> tuple[F64, F64]:
    """(L, N) sums over blocks of the mean of two halves (2, L, H, W), and (L, N, BLOCK^2) half differences."""
    pad = [(0, -n % BLOCK) for n in halves.shape[-2:]]
    halves = np.pad(halves, [(0, 0), (0, 0), *pad])
    rows, columns = (n // BLOCK for n in halves.shape[-2:])
    parts = np.moveaxis(halves.reshape(2, -1, rows, BLOCK, columns, BLOCK), 4, 3)
    a, b = parts.reshape(2, -1, rows * columns, BLOCK**2)
    return ((a + b) / 2).sum(axis=-1), (a - b) / 2


def shared(difference: F64) -> F64:
    """(L,) variance of a block's sum over that of independent pixels, at least 1. difference: (L, N, BLOCK^2)."""
    alone = (difference**2).sum(axis=-1)
    ratio = np.divide(difference.sum(axis=-1) ** 2, alone, out=np.zeros_like(alone), where=alone > 0)
    return np.asarray(np.maximum(ratio.sum(axis=-1) / np.maximum((alone > 0).sum(axis=-1), 1), 1.0))
