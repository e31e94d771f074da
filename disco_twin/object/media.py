"""Media: sigma_t and albedo per wavelength on a grid, from a homogeneous base, a measured material or voxel files.

Features are laid over the base in order, each mixed in linearly in sigma_s and sigma_a by the share of the voxel that
it covers, so that a sheet thinner than a voxel keeps its optical thickness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from disco_twin.object.features import coverage
from disco_twin.object.voxels import read_voxels
from disco_twin.scene.materials import measured
from disco_twin.scene.object_schema import Grid, HollowCore, Homogeneous, MediumConfig
from hw.base.arrays import F32, F64
from hw.base.errors import InputError

KEY = "object.medium"
MOST_CELLS = 30_000_000  # 360 MB a wavelength while the medium is built


@dataclass(frozen=True)
class Medium:
    """Cell-centred grid, trilinear in sigma_t and in sigma_s = sigma_t * albedo between centres, clamped outside them.

    sigma_t: (L, nz, ny, nx) float32 in 1/mm, homogeneous (L, 1, 1, 1); albedo: the same shape, 0 .. 1
    low, high: (3,) x, y, z corners of the grid in mm, object frame; g: L asymmetries (Henyey-Greenstein)
    """

    sigma_t: F32
    albedo: F32
    low: F64
    high: F64
    g: tuple[float, ...]


def build_medium(config: MediumConfig, mesh: trimesh.Trimesh, wavelengths_nm: Sequence[float]) -> Medium:
    """The medium that fills `mesh`, for each laser. Raises: InputError for a grid or a feature that does not fit."""
    base = _base(config, mesh, wavelengths_nm)
    return _with_features(config, base, mesh) if config.features else base


def _base(config: MediumConfig, mesh: trimesh.Trimesh, wavelengths_nm: Sequence[float]) -> Medium:
    lasers = len(wavelengths_nm)
    g = tuple(float(x) for x in _per_wavelength(config.g, lasers))
    low, high = np.array(mesh.bounds, dtype=float)
    base = config.base
    if isinstance(base, Grid):
        return _grid(base, mesh, lasers, g)
    if isinstance(base, Homogeneous):
        sigma_t, albedo = _per_wavelength(base.sigma_t_per_mm, lasers), _per_wavelength(base.albedo, lasers)
    else:
        sigma_t, albedo = measured(base.name, wavelengths_nm)
    return Medium(_column(sigma_t).astype(np.float32), _column(albedo).astype(np.float32), low, high, g)


def _grid(base: Grid, mesh: trimesh.Trimesh, lasers: int, g: tuple[float, ...]) -> Medium:
    key = f"{KEY}.base"
    density = read_voxels(base.sigma_t_file, lasers, f"{key}.sigma_t_file")
    albedo: NDArray[np.floating]
    if base.albedo_file is not None:
        albedo = read_voxels(base.albedo_file, lasers, f"{key}.albedo_file", highest=1.0).values
        if albedo.shape[1:] != density.values.shape[1:]:
            problem = f"the albedo grid is {albedo.shape[1:]}, sigma_t is {density.values.shape[1:]} (nz, ny, nx)"
            remedy = "give both grids the same voxels"
            raise InputError(problem, file=base.albedo_file, key=f"{key}.albedo_file", remedy=remedy)
    else:
        assert base.albedo is not None  # the schema asks for exactly one of the two
        albedo = _column(_per_wavelength(base.albedo, lasers))
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
    return Medium(sigma_t, albedo, low, high, g)


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
            t = _column(_per_wavelength(feature.sigma_t_per_mm, lasers))
            a = _column(_per_wavelength(feature.albedo, lasers))
        sigma_s += weight * (t * a - sigma_s)
        sigma_a += weight * (t * (1 - a) - sigma_a)
    total = sigma_s + sigma_a
    ratio = np.divide(sigma_s, total, out=np.zeros_like(total), where=total > 0)
    return Medium(total.astype(np.float32), ratio.astype(np.float32), low, high, base.g)


def cell_centres(low: F64, high: F64, shape: tuple[int, ...]) -> F64:
    """(nz * ny * nx, 3) x, y, z of the cell centres of a (nz, ny, nx) grid, x fastest."""
    z, y, x = (a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in zip(low[::-1], high[::-1], shape, strict=True))
    zz, yy, xx = np.meshgrid(z, y, x, indexing="ij")
    return np.column_stack([xx.ravel(), yy.ravel(), zz.ravel()])


def _per_wavelength(value: ArrayLike, lasers: int) -> F64:
    """(L,) values from one for all lasers or one a laser (the scene's schema has checked the count)."""
    return np.array(np.broadcast_to(np.atleast_1d(np.asarray(value, float)), (lasers,)))


def _column(values: F64) -> F64:
    """(L,) -> (L, 1, 1, 1)."""
    return values[:, None, None, None]


def _mm(point: F64) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in point) + ")"
