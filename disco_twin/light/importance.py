"""How much light reaches each part of the object, by the diffusion equation, and the weight windows made from it.

- div(D grad phi) + sigma_a phi = source, D = 1 / (3 (sigma_a + sigma_s')), with the partial-current boundary condition
of a refractive surface (Haskell et al. 1994, eq. 2.3.8), by finite volumes on cells some free paths wide. It is an
estimate: it decides where photons go, and its errors cost time, never truth. On the quick scene it predicts R_d within
a factor of 1.6 (one standard deviation) from the second decade below the peak to the fifth.

Windows that follow the forward fluence keep the density of photons even (Cooper and Larsen 2001): the fainter the
light, the lighter its carriers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from disco_twin.object.bodies import OwnMedium
from disco_twin.object.build import TwinObject
from hw.base.arrays import F64, I64, Bool

CELLS = 32  # along the object's longest side
INNER_POINTS = 3  # of each cell and axis, at which the medium is read
DARKEST = 3e-6  # of the brightest fluence, which R_d follows: 1e-5 of the peak is what is asked for, and then some
HEAVIEST = 8.0  # target weight: where no view looks photons are few, but not so few that what diffusion missed is lost
STEEPEST = 32.0  # ratio of neighbouring cells' targets: where diffusion falls too fast, photons must not burst


@dataclass(frozen=True)
class Splitting:
    """Where each tag's light enters, (T, 3) or (T, P, 3) in mm for P places alike, and how many times the collisions of
    an unsplit walk to spend.

    What effort buys: docs/decisions/0050. part: of images that plain and split walks make together
    (`splitting.counted`) whose these are, with `plain` of the former to each of the latter; their sum is the whole.
    """

    entries: F64
    effort: float = 3.0
    part: Literal["plain", "split"] | None = None
    plain: float = 1.0


@dataclass(frozen=True)
class Views:
    """What photons are to reach, for windows that lead there: light enters at `entries` (N, 3), and `seen` holds, per
    view, the (M, 3) points of the surface that its pixels show; mm.
    """

    entries: F64
    seen: tuple[F64, ...]


@dataclass(frozen=True)
class Diffusion:
    """The equation, factorised, for one wavelength.

    filled: (n, n, n) whether the cell's middle lies in the object; number: (n, n, n) its unknown, the nearest one's
    outside; both indexed [z, y, x]; low: corner in mm; cell: edge in mm; factor: solves for the fluence of 1 W, 1/mm^2;
    sigma_t, absorption, reduced: (unknowns,) 1/mm, the latter sigma_s'; leak: power that leaves per area of the surface
    and fluence.
    """

    filled: Bool
    number: I64
    low: F64
    cell: float
    factor: Any
    sigma_t: F64
    absorption: F64
    reduced: F64
    leak: float

    def unknowns(self, points: ArrayLike) -> I64:
        """(N,) numbers of the cells that `points` (N, 3) lie in, clamped to the object."""
        n = len(self.number)
        index = np.clip(np.floor((np.asarray(points, float) - self.low) / self.cell).astype(int), 0, n - 1)
        return np.asarray(self.number[index[:, 2], index[:, 1], index[:, 0]])

    def fluence(self, points: ArrayLike) -> F64:
        """(N, n, n, n) fluence of N sources of 1 W, each at `points` (N, 3) or shared among places (N, P, 3)."""
        places = np.asarray(points, float).reshape(len(np.asarray(points)), -1, 3)
        cells = self.unknowns(places.reshape(-1, 3)).reshape(places.shape[:2])
        right = np.zeros((self.factor.shape[0], len(cells)))
        np.add.at(right, (cells, np.arange(len(cells))[:, None]), 1.0 / cells.shape[1])
        return np.ascontiguousarray(np.moveaxis(self.factor.solve(right)[self.number], -1, 0))

    def collisions(self, points: ArrayLike) -> float:
        """How often a photon that enters at one of `points` (N, 3) is scattered before it leaves, in the mean."""
        cells = self.unknowns(points)
        reached, spent = self.below_surface(cells)
        right = np.bincount(cells, reached, minlength=self.factor.shape[0]) / len(cells)
        inner = float(self.factor.solve(right) @ self.sigma_t) * self.cell**3
        return inner + float((spent * self.sigma_t[cells]).mean())

    def below_surface(self, cells: I64) -> tuple[F64, F64]:
        """Light that enters scatters first a transport free path below the surface, often far above the cell's middle.

        (N,) share that reaches the middle of its cell, and (N,) mm flown until then by all, in the slab of half a cell
        between the surface, which leaks, and the middle, which is held dark: D u'' = sigma_a u, D u'(0) = leak u(0).
        """
        transport = np.maximum(self.absorption[cells] + self.reduced[cells], 1e-12)
        d, half = 1 / (3 * transport), self.cell / 2
        start = np.minimum(1 / transport, half)
        k = np.maximum(np.sqrt(self.absorption[cells] / d), 1e-4 / half)
        conduct = self.leak / (k * d)

        def from_surface(z: F64 | float) -> F64:
            """cosh(k z) + conduct sinh(k z), times 2 exp(-k z)."""
            return np.asarray(1 + conduct + (1 - conduct) * np.exp(-2 * k * z))

        left = np.exp(k * (start - half))
        reached = left * from_surface(start) / from_surface(half)
        leaked = conduct * np.exp(-k * start) * (1 - left**2) / from_surface(half)
        return reached, np.maximum(1 - reached - leaked, 0) / (k**2 * d)

    def spread(self, points: ArrayLike) -> F64:
        """(cells,) fluence of 1 W shared among the `points` (N, 3)."""
        right = np.bincount(self.unknowns(points), minlength=self.factor.shape[0]) / len(np.asarray(points))
        return np.asarray(self.factor.solve(right))


def mean_coefficients(obj: TwinObject, laser: int, centres: F64, cell: float) -> tuple[F64, F64, F64]:
    """(N,) sigma_a, sigma_s and sigma_s' in 1/mm, averaged over the cells at `centres` (N, 3)."""
    medium = obj.medium
    sigma_t = medium.sigma_t[laser].astype(float)
    scatter = sigma_t * medium.albedo[laser]
    read = [sigma_t - scatter, scatter]
    if medium.g_voxels is not None:
        read.append(scatter * (1 - medium.g_voxels[laser].astype(float)))
    sums = np.zeros((len(read), len(centres)))
    size = np.asarray(medium.high) - np.asarray(medium.low)
    steps = (np.arange(INNER_POINTS) + 0.5) / INNER_POINTS - 0.5
    for shift in np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3) * cell:
        grid = (centres + shift - medium.low) / size * np.array(sigma_t.shape[::-1]) - 0.5
        for k, values in enumerate(read):
            sums[k] += ndimage.map_coordinates(values, grid[:, ::-1].T, order=1, mode="nearest")
    absorption, scattering, *reduced = sums / INNER_POINTS**3
    found = absorption, scattering, reduced[0] if reduced else scattering * (1 - medium.g[laser])
    return _in_bodies(obj, laser, centres, found) if obj.inside else found


def _in_bodies(obj: TwinObject, laser: int, centres: F64, coefficients: tuple[F64, F64, F64]) -> tuple[F64, F64, F64]:
    """The coefficients where bodies inside hold the cells' middles, too. Walls bend no light here."""
    found, grid = np.stack(coefficients), np.stack(coefficients)
    for body in obj.inside:
        held = np.asarray(body.mesh.contains(centres))
        if isinstance(body.medium, OwnMedium):
            sigma_t, albedo, g = (values[laser] for values in (body.medium.sigma_t, body.medium.albedo, body.medium.g))
            found[:, held] = np.array([1 - albedo, albedo, albedo * (1 - g)])[:, None] * sigma_t
        else:
            found[:, held] = grid[:, held] if body.medium else 0.0
    return found[0], found[1], found[2]


def diffusion(obj: TwinObject, laser: int, cells: int = CELLS) -> Diffusion:
    """Set the equation up for the object and one of its wavelengths, and factorise it."""
    low, high = np.asarray(obj.mesh.bounds, float)
    cell = float((high - low).max()) / cells
    n = cells + 2
    corner = (low + high) / 2 - n * cell / 2
    axis = (np.arange(n) + 0.5) * cell
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    centres = corner + np.stack([x, y, z], axis=-1).reshape(-1, 3)
    filled = obj.mesh.contains(centres).reshape(n, n, n)
    if not filled.any():  # thinner than a cell everywhere
        filled[n // 2, n // 2, n // 2] = True
    number = np.full((n, n, n), -1)
    number[filled] = np.arange(filled.sum())
    absorption, scattering, reduced = mean_coefficients(obj, laser, centres[filled.ravel()], cell)
    transport = np.maximum(absorption + reduced, 1e-3 / cell)
    d = 1 / (3 * transport)
    eta = obj.boundary.eta
    # Internal diffuse reflection of a smooth surface (Egan and Hilgeman 1979).
    inner = 0.0 if eta == 1 else np.clip(-1.440 / eta**2 + 0.710 / eta + 0.668 + 0.0636 * eta, 0.0, 0.99)
    leak = 0.5 * (1 - inner) / (1 + inner)
    diagonal = absorption * cell**3
    rows, columns, values = [], [], []
    for side in range(3):
        for step in (-1, 1):
            other = np.roll(number, -step, axis=side)[filled]
            own, both = number[filled], other >= 0
            link = cell * 2 * d[both] * d[other[both]] / (d[both] + d[other[both]])
            diagonal[both] += link
            rows.append(own[both])
            columns.append(other[both])
            values.append(-link)
            # Half a cell of diffusion in series with the surface's leak.
            diagonal[~both] += cell**2 / (cell / (2 * d[~both]) + 1 / leak)
    matrix = (
        sparse.coo_array(
            (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(len(d), len(d))
        ).tocsc()
        + sparse.diags_array(diagonal).tocsc()
    )
    options = {"SymmetricMode": True}
    factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    nearest = ndimage.distance_transform_edt(~filled, return_indices=True, return_distances=False)
    sigma_t = absorption + scattering
    return Diffusion(
        filled, number[tuple(nearest)], corner, cell, factor, sigma_t, absorption, reduced, float(leak)
    )  # fmt: skip


def view_targets(estimate: Diffusion, views: Views) -> F64:
    """(1, n, n, n) target weights: the importance at the entry over that at a place, for all views together.

    Importance is the adjoint fluence (Wagner and Haghighat 1998, CADIS): the diffusion operator is its own adjoint, so
    it is the fluence of sources in the cells that a view shows. A view counts by the reciprocal of its brightness, the
    signal-weighted mean of the fluence in what it shows, so that faint views become as precise as bright ones (Wagner
    et al. 2014, FW-CADIS, with one response a view).
    """
    forward = estimate.spread(views.entries)
    adjoint = np.zeros_like(forward)
    for points in views.seen:
        cells = estimate.unknowns(points)
        shown = forward[cells]
        adjoint += estimate.spread(points) * len(points) * shown.sum() / (shown**2).sum()
    entry = float(adjoint[estimate.unknowns(views.entries)].mean())
    targets = np.clip(entry / adjoint, DARKEST, HEAVIEST)[estimate.number]
    return in_steps(np.maximum(targets, ndimage.maximum_filter(targets, 3) / STEEPEST))[None]


def in_steps(targets: F64) -> F64:
    """Rounded to a quarter octave: the solver's last bit must not decide about a photon."""
    return np.asarray(np.exp2(np.round(4 * np.log2(targets)) / 4))


def window_targets(fluence: F64, filled: Bool, effort: float) -> F64:
    """(N, n, n, n) target weights: min(1, fluence / f), with the f at which `effort` times the collisions are made.

    Photons of weight w are met fluence / w times: the fluence itself without windows, and max(fluence, f) with them,
    down to where the light is DARKEST; still fainter light is left to itself.
    """
    targets = np.empty_like(fluence)
    for target, values in zip(targets, fluence, strict=True):
        inside = values[filled]
        kept = np.maximum(values, DARKEST * inside.max())

        def collisions(level: float, inside: F64 = inside, kept: F64 = kept[filled]) -> float:
            return float((inside / np.minimum(kept / level, 1.0)).sum())

        low, high = float(kept[filled].min()), float(inside.max())
        for _ in range(30):
            level = math.sqrt(low * high)
            low, high = (low, level) if collisions(level) > effort * inside.sum() else (level, high)
        target[...] = np.minimum(kept / low, 1.0)
        np.maximum(target, ndimage.maximum_filter(target, 3) / STEEPEST, out=target)
    return in_steps(targets)
