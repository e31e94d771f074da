"""Local majorants: an upper bound of sigma_t around each cell of the distance field.

Null-collision tracking is exact for every majorant that is nowhere exceeded along the flight, and costs collisions in
proportion to it. A photon therefore flies by the bound of a cube around its cell; where the flight would leave the
cube it stops at the cube's rim without a collision and draws the rest anew, since exponential flights have no memory
(Szirmay-Kalos et al. 2011).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from hw.base.arrays import F32, F64, I64

STRETCHES = (2, 4, 8, 16)  # cells that a flight may move along each axis, tried
WORTHWHILE = 0.8  # share of the flights, above which one majorant for all does as well


@dataclass(frozen=True)
class LocalMajorants:
    """rate: (n, n, n) float32 in 1/mm, index [z, y, x]: the bound for places that start in the cell and move no more
    than `stretch` mm along any axis; flights: expected number beside that under one majorant for the whole object.
    """

    rate: F32
    stretch: float
    flights: float


def greatest_in_cells(sigma_t: F64, medium_low: F64, medium_high: F64, low: F64, cell: float, cells: int) -> F64:
    """(cells,)*3 greatest value that the voxel look-up can return anywhere in each cell.

    The look-up draws a voxel within one of the point, per axis, clamped to the grid (`tables.medium_at`).
    """
    found = np.asarray(sigma_t, float)
    for axis, coordinate in ((2, 0), (1, 1), (0, 2)):
        count = sigma_t.shape[axis]
        voxel = (medium_high[coordinate] - medium_low[coordinate]) / count
        edges = (low[coordinate] + cell * np.arange(cells + 1) - medium_low[coordinate]) / voxel - 0.5
        # A hair more than the cell: the walk finds its cell and its voxel in single precision.
        first = np.clip(np.floor(edges[:-1] - 1e-3), 0, count - 1).astype(int)
        last = np.clip(np.floor(edges[1:] + 1.0 + 1e-3), 0, count - 1).astype(int)
        parts = [found.take(range(a, b + 1), axis).max(axis) for a, b in zip(first, last, strict=True)]
        found = np.stack(parts, axis)
    return found


def local_majorants(
    sigma_t: F64, medium_low: F64, medium_high: F64, low: F64, cell: float, cells: int, inside: I64
) -> LocalMajorants | None:
    """The majorants whose stretch asks for the fewest flights in the cells `inside`, (N, 3) indices [z, y, x]; None
    where one for all does nearly as well, or where the object is thinner than the cells.
    """
    if not len(inside):
        return None
    highest = max(float(sigma_t.max()), 1e-9)
    within = greatest_in_cells(sigma_t, medium_low, medium_high, low, cell, cells)
    best: LocalMajorants | None = None
    for moved in STRETCHES:
        rate = np.maximum(ndimage.maximum_filter(within, 2 * moved + 1, mode="nearest"), 1e-3 * highest)
        stretch = moved * cell * (1 - 1e-4)  # single precision must not lead into the next cell
        # Flights end at collisions or after the stretch: rate / (1 - exp(-rate * stretch)) a mm.
        found = rate[tuple(inside.T)]
        flights = float(np.mean(found / -np.expm1(-found * stretch))) / highest
        if best is None or flights < best.flights:
            best = LocalMajorants(rate.astype(np.float32), stretch, flights)
    return best if best is not None and best.flights < WORTHWHILE else None
