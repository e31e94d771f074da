"""Media: sigma_t and albedo per wavelength on a grid, from a homogeneous base, a measured material or voxel files.

Features are laid over the base in order, each mixed in linearly in sigma_s and sigma_a by the share of the voxel that
it covers, so that a sheet thinner than a voxel keeps its optical thickness. Asymmetries are mixed by sigma_s: a voxel
keeps the mean cosine of what it holds, and so its reduced scattering.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from disco_twin.object.features import coverage
from disco_twin.object.voxels import Voxels, read_voxels
from disco_twin.scene.materials import measured
from disco_twin.scene.object_schema import (
    MOST_G,
    MOST_SIGMA_T,
    Feature,
    Grid,
    HollowCore,
    Homogeneous,
    MediumConfig,
)
from hw.base.arrays import F32, F64
from hw.base.errors import InputError

KEY = "object.medium"
MOST_CELLS = 30_000_000  # 360 MB a wavelength while the medium is built


@dataclass(frozen=True)
class Medium:
    """Cell-centred grid, trilinear in sigma_t and in sigma_s = sigma_t * albedo between centres, clamped outside them.

    sigma_t: (L, nz, ny, nx) float32 in 1/mm, homogeneous (L, 1, 1, 1); albedo: the same shape, 0 .. 1
    low, high: (3,) x, y, z corners of the grid in mm, object frame; g: L asymmetries (Henyey-Greenstein), where they
    vary the means over what scatters; g_voxels: (L, nz, ny, nx) float32 where they vary, else None. Between centres the
    phase function is interpolated as sigma_s is.
    """

    sigma_t: F32
    albedo: F32
    low: F64
    high: F64
    g: tuple[float, ...]
    g_voxels: F32 | None = None

    def of_lasers(self, lasers: Sequence[int]) -> Medium:
        """The medium for some of its wavelengths, in this order; one may come more than once."""
        own = list(lasers)
        g_voxels = None if self.g_voxels is None else self.g_voxels[own]
        g = tuple(self.g[k] for k in own)
        return Medium(self.sigma_t[own], self.albedo[own], self.low, self.high, g, g_voxels)

    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Laser indices that share sigma_t and g exactly, so that one walk serves them."""
        alike: dict[tuple[object, ...], list[int]] = {}
        for k, sigma_t in enumerate(self.sigma_t):
            g = self.g[k] if self.g_voxels is None else self.g_voxels[k].tobytes()
            alike.setdefault((sigma_t.tobytes(), g), []).append(k)
        return tuple(tuple(group) for group in alike.values())


def build_medium(config: MediumConfig, mesh: trimesh.Trimesh, wavelengths_nm: Sequence[float]) -> Medium:
    """The medium that fills `mesh`, for each laser. Raises: InputError for a grid or a feature that does not fit."""
    base = _base(config, mesh, wavelengths_nm)
    return _with_features(config, base, mesh) if config.features else base


def _base(config: MediumConfig, mesh: trimesh.Trimesh, wavelengths_nm: Sequence[float]) -> Medium:
    lasers = len(wavelengths_nm)
    g = tuple(float(x) for x in per_wavelength(config.g, lasers))
    low, high = np.array(mesh.bounds, dtype=float)
    base = config.base
    if isinstance(base, Grid):
        return _grid(base, mesh, lasers, g)
    if isinstance(base, Homogeneous):
        sigma_t, albedo = per_wavelength(base.sigma_t_per_mm, lasers), per_wavelength(base.albedo, lasers)
    else:
        sigma_t, albedo = measured(base.name, wavelengths_nm)
    return Medium(_column(sigma_t).astype(np.float32), _column(albedo).astype(np.float32), low, high, g)


def _grid(base: Grid, mesh: trimesh.Trimesh, lasers: int, g: tuple[float, ...]) -> Medium:
    key = f"{KEY}.base"
    density = read_voxels(base.sigma_t_file, lasers, f"{key}.sigma_t_file", MOST_SIGMA_T)
    albedo: NDArray[np.floating]
    if base.albedo_file is not None:
        albedo = _beside(density, base.albedo_file, lasers, "albedo", 0.0)
    else:
        assert base.albedo is not None  # the schema asks for exactly one of the two
        albedo = _column(per_wavelength(base.albedo, lasers))
    low = density.low if base.low_mm is None else np.array(base.low_mm)
    high = density.high if base.high_mm is None else np.array(base.high_mm)
    if low is None or high is None:
        problem = "required for a .npy grid: its x, y, z corners in mm"
        raise InputError(problem, key=f"{key}.low_mm and high_mm", remedy="add both")
    if not (low < high).all():
        problem, remedy = f"the grid's corners are {_mm(low)} and {_mm(high)} mm", "exchange low_mm and high_mm"
        raise InputError(problem, file=base.sigma_t_file, key=key, allowed="low_mm < high_mm", remedy=remedy)
    tolerance = 1e-6 * mesh.extents
    if (mesh.bounds[0] < low - tolerance).any() or (mesh.bounds[1] > high + tolerance).any():
        problem = f"the grid from {_mm(low)} to {_mm(high)} mm does not cover the object"
        needed = f"low_mm <= {_mm(mesh.bounds[0])}, high_mm >= {_mm(mesh.bounds[1])}"
        remedy = "set low_mm and high_mm to the corners of the outermost voxels"
        raise InputError(problem, file=base.sigma_t_file, key=key, allowed=needed, remedy=remedy)
    shape = (lasers, *density.values.shape[1:])
    sigma_t, albedo = (np.broadcast_to(v, shape).astype(np.float32) for v in (density.values, albedo))
    if base.g_file is None:
        return Medium(sigma_t, albedo, low, high, g)
    own = np.broadcast_to(_beside(density, base.g_file, lasers, "g", -MOST_G, MOST_G), shape)
    return with_g(Medium(sigma_t, albedo, low, high, g), own)


def _beside(density: Voxels, path: Path, lasers: int, what: str, lowest: float, highest: float = 1.0) -> F32:
    """(C, nz, ny, nx) of another file with the voxels of sigma_t."""
    key = f"{KEY}.base.{what}_file"
    found = read_voxels(path, lasers, key, highest, lowest).values
    if found.shape[1:] != density.values.shape[1:]:
        problem = f"the {what} grid is {found.shape[1:]}, sigma_t is {density.values.shape[1:]} (nz, ny, nx)"
        raise InputError(problem, file=path, key=key, remedy="give both grids the same voxels")
    return found


def with_g(medium: Medium, g: NDArray[np.floating]) -> Medium:
    """The medium with asymmetries (L, nz, ny, nx) of its voxels, and their means weighted by sigma_s."""
    g = g.astype(np.float32)
    weight = np.asarray(medium.sigma_t * medium.albedo, np.float64).reshape(len(g), -1)
    mean = [float(np.average(a.ravel(), weights=w if w.any() else None)) for a, w in zip(g, weight, strict=True)]
    return replace(medium, g=tuple(mean), g_voxels=g)


def _with_features(config: MediumConfig, base: Medium, mesh: trimesh.Trimesh) -> Medium:
    """Lay the features over the base: on its own voxels if it is a grid, else on voxels of `cell_mm`."""
    lasers, shape = len(base.g), base.sigma_t.shape[1:]
    low, high = base.low, base.high
    if not isinstance(config.base, Grid):
        cells = np.ceil((high - low) / config.cell_mm).astype(int) + 2  # one more on each side
        if np.prod(cells.astype(float)) > MOST_CELLS:
            problem = f"the medium would have {np.prod(cells.astype(float)):.3g} voxels"
            key, most = f"{KEY}.cell_mm", f"at most {MOST_CELLS:.3g} voxels"
            raise InputError(problem, key=key, value=config.cell_mm, allowed=most, remedy="use larger voxels")
        low, high = (low + high - cells * config.cell_mm) / 2, (low + high + cells * config.cell_mm) / 2
        shape = (int(cells[2]), int(cells[1]), int(cells[0]))
    sigma_t, albedo = (np.asarray(v, float) for v in (base.sigma_t, base.albedo))
    sigma_s = np.broadcast_to(sigma_t * albedo, (lasers, *shape)).copy()
    sigma_a = np.broadcast_to(sigma_t * (1 - albedo), (lasers, *shape)).copy()
    varied = base.g_voxels is not None or any(np.any(_g_of(f, base) != base.g) for f in config.features)
    forward = sigma_s * (_column(np.array(base.g)) if base.g_voxels is None else base.g_voxels) if varied else None
    centres = cell_centres(low, high, shape)
    cell = float(np.max((high - low) / np.array(shape[::-1])))
    for i, feature in enumerate(config.features):
        weight = coverage(feature, centres, cell, mesh).reshape(shape)
        if not weight.any():
            problem = f"the {feature.kind} lies outside the object, which spans {_mm(low)} to {_mm(high)} mm"
            raise InputError(problem, key=f"{KEY}.features[{i}]", remedy="move it, or take it out")
        if isinstance(feature, HollowCore):
            t = a = np.zeros((lasers, 1, 1, 1))
        else:
            t = _column(per_wavelength(feature.sigma_t_per_mm, lasers))
            a = _column(per_wavelength(feature.albedo, lasers))
        sigma_s += weight * (t * a - sigma_s)
        sigma_a += weight * (t * (1 - a) - sigma_a)
        if forward is not None:
            forward += weight * (t * a * _column(_g_of(feature, base)) - forward)
    total = sigma_s + sigma_a
    ratio = np.divide(sigma_s, total, out=np.zeros_like(total), where=total > 0)
    mixed = Medium(total.astype(np.float32), ratio.astype(np.float32), low, high, base.g)
    if forward is None:
        return mixed
    parts = np.stack([np.array(base.g), *(_g_of(feature, base) for feature in config.features)])
    own = [b"" if base.g_voxels is None else base.g_voxels[k].tobytes() for k in range(lasers)]
    alike = [(mixed.sigma_t[k].tobytes(), own[k], *parts[:, k]) for k in range(lasers)]
    return with_g(mixed, _mean_cosines(sigma_s, forward, alike))


def _g_of(feature: Feature, base: Medium) -> F64:
    """(L,) asymmetries of a feature."""
    own = None if isinstance(feature, HollowCore) else feature.g
    return per_wavelength(base.g if own is None else own, len(base.g))


def _mean_cosines(sigma_s: F64, forward: F64, lasers: Sequence[Hashable]) -> F64:
    """(L, nz, ny, nx) asymmetries forward / sigma_s of mixed voxels.

    Lasers of one name in `lasers` differ in albedo alone: they weigh the parts by their mean sigma_s, and so keep one
    asymmetry and one walk.
    """
    out = np.empty_like(sigma_s)
    for name in set(lasers):
        own = [k for k, other in enumerate(lasers) if other == name]
        total = sigma_s[own].mean(axis=0)
        out[own] = np.divide(forward[own].mean(axis=0), total, out=np.zeros_like(total), where=total > 0)
    return out


def cell_centres(low: F64, high: F64, shape: tuple[int, ...]) -> F64:
    """(nz * ny * nx, 3) x, y, z of the cell centres of a (nz, ny, nx) grid, x fastest."""
    z, y, x = (a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in zip(low[::-1], high[::-1], shape, strict=True))
    zz, yy, xx = np.meshgrid(z, y, x, indexing="ij")
    return np.column_stack([xx.ravel(), yy.ravel(), zz.ravel()])


def per_wavelength(value: ArrayLike, lasers: int) -> F64:
    """(L,) values from one for all lasers or one a laser (the scene's schema has checked the count)."""
    return np.array(np.broadcast_to(np.atleast_1d(np.asarray(value, float)), (lasers,)))


def _column(values: F64) -> F64:
    """(L,) -> (L, 1, 1, 1)."""
    return values[:, None, None, None]


def _mm(point: F64) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in point) + ")"
