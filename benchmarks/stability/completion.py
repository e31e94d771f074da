"""Completion: from samples to all entries, where data are missing, alone, worthless or of every precision at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh
from scipy import sparse

from benchmarks.stability.case import Ends, Family, relative
from benchmarks.stability.material import support
from hw.base.arrays import F64
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.mesh_file import read_scan
from pipeline.reconstruct.baselines.dipole import fit_dipole
from pipeline.reconstruct.baselines.disco2004 import resample_2004
from pipeline.reconstruct.baselines.lambertian import fit_lambertian
from pipeline.reconstruct.global_term.completion import SymmetricField, complete
from pipeline.reconstruct.global_term.harmonics import Harmonics, harmonics
from pipeline.reconstruct.samples.samples import Samples

FAMILY = Family("completion")
METHODS: dict[str, Callable[[Samples], Any]] = {
    "the default": complete,
    "disco2004": resample_2004,
    "dipole": fit_dipole,
    "lambertian": fit_lambertian,
}


@cache
def ball(subdivisions: int = 1, spots: int = 40, hidden: float = 0.3) -> Any:
    """Samples of a ball of 10 mm whose R_d is known; not to be changed."""
    return support("reconstruct_synthetic").make(subdivisions, spots, hidden=hidden)


def entries(samples: Samples, method: str = "the default") -> F64:
    """(V, V) of the model that a method makes."""
    model = METHODS[method](samples)
    columns = model.reflectance_columns(np.arange(len(samples.mesh.vertices)))
    if columns is None:
        throughput = model.leaving(np.arange(len(samples.mesh.vertices)), RayMesh.of(samples.mesh).vertex_areas)
        return np.asarray(throughput[0], np.float64)
    return np.asarray(columns.mean[0], np.float64)


def log_rmse(samples: Samples, truth: F64, method: str = "the default") -> float:
    """Of log10 of the entries; not finite where one is not above 0."""
    found = entries(samples, method)
    return float(np.sqrt((np.log10(np.where(found > 0, found, np.nan) / truth) ** 2).mean()))


def with_values(change: Callable[[Any], Any], hidden: float = 0.3) -> Samples:
    """The ball's samples with other values: NaN where nothing was observed."""
    own: Samples = ball(hidden=hidden).samples
    values = own.values.copy()
    change(values)
    return replace(own, values=values)


def none(values: Any) -> None:
    values[:] = np.nan


def only_one(values: Any) -> None:
    kept = values[0, 3, np.flatnonzero(np.isfinite(values[0, 3]))[0]]
    at = np.argwhere(values[0] == kept)[0]
    values[:] = np.nan
    values[0, at[0], at[1]] = kept


def one_spot(values: Any) -> None:
    values[:, 1:] = np.nan


def noise(values: Any) -> None:
    values[np.isfinite(values)] = 1e-3 * np.random.default_rng(0).standard_normal(np.isfinite(values).sum())


def darkness(values: Any) -> None:
    values[np.isfinite(values)] = 0.0


def finite(change: Callable[[Any], None], method: str = "the default") -> float:
    """How many entries are not finite, or below 0."""
    found = entries(with_values(change), method)
    return float((~np.isfinite(found) | (found < 0)).sum())


for name, change, extent in (
    ("no datum at all", none, "0 samples"),
    ("one datum", only_one, "1 sample"),
    ("one spot", one_spot, "40 samples"),
    ("pure noise", noise, "signal 0"),
    ("darkness", darkness, "all samples 0"),
):
    FAMILY.case(
        name,
        "finite entries, none below 0, or a refusal in one line",
        extent,
        ends=Ends.EITHER,
        slow=change in (only_one, one_spot, noise),
        rivals={method: partial(finite, change, method) for method in METHODS if method != "the default"},
    )(partial(finite, change))


@FAMILY.case("all data", "log10 of the entries within .06 rms", "every vertex seen from every spot", 0.06)
def everything() -> float:
    own = ball(hidden=0.0)
    return log_rmse(own.samples, own.truth[0])


def of_scale(factor: float) -> float:
    """Largest relative difference of entries from those of samples in another unit."""
    own, f = ball().samples, np.float32(factor)
    scaled = replace(
        own, values=own.values * f, dark_variance=own.dark_variance * f * f, noise_per_signal=own.noise_per_signal * f
    )
    return relative(entries(scaled), factor * entries(own))


FAMILY.case(
    "an object that gives back 1e-12 of its light",
    "the same entries, 1e-12 times as much",
    "R_d of 1e-15 / mm^2",
    1e-3,
    slow=True,
)(partial(of_scale, 1e-12))
FAMILY.case(
    "a thousand times more light than arrived",
    "refused: a power in another unit",
    "mW taken for W",
    ends=Ends.REFUSED,
    slow=True,
)(partial(of_scale, 1e3))


def of_length(factor: float) -> float:
    """An object `factor` times as large: R_d falls with its square."""
    own = ball().samples
    mesh = trimesh.Trimesh(own.mesh.vertices * factor, own.mesh.faces, process=False)
    spots = replace(own.spots, position=own.spots.position * factor, beam_radius=own.spots.beam_radius * factor)
    f = np.float32(factor**-2)
    large = replace(own, mesh=mesh, spots=spots, values=own.values * f, noise_per_signal=own.noise_per_signal * f)
    return relative(entries(large), factor**-2 * entries(own))


for factor in (0.05, 15.0):
    FAMILY.case(
        f"an object of {20 * factor:g} mm",
        "the same entries, by the square of the length",
        f"{20 * factor:g} mm",
        2e-3,
        slow=True,
    )(partial(of_length, factor))


@FAMILY.case(
    "samples whose variances differ by 12 decades",
    "next to spots precise samples stand, worthless ones do not",
    "1e-12 .. 1 of the value squared",
    0.2,
    slow=True,
)
def precisions() -> float:
    own, rng = ball(hidden=0.0), np.random.default_rng(5)
    size = 10.0 ** rng.uniform(-6, 0, own.samples.values.shape)  # relative deviation
    exact = own.samples.values.astype(np.float64)
    seen = exact * (1 + size * rng.standard_normal(exact.shape))
    samples = replace(
        own.samples,
        values=seen.astype(np.float32),
        dark_variance=((size * exact) ** 2).astype(np.float32),
        noise_per_signal=np.zeros_like(own.samples.values),
    )
    return log_rmse(samples, own.truth[0])


@FAMILY.case(
    "a wild sample among good ones",
    "log10 of the entries of other spots and vertices within .06 rms",
    "1e6 times its neighbours",
    0.06,
    slow=True,
)
def wild() -> float:
    own, spot, vertex = ball(hidden=0.0), 5, 7
    values = own.samples.values.copy()
    values[0, spot, vertex] *= 1e6
    found = entries(replace(own.samples, values=values))
    others = np.ones(len(found), bool)
    others[[vertex, *own.samples.mesh.faces[own.samples.spots.triangle[spot]]]] = False
    miss = np.log10(found / own.truth[0])[np.ix_(others, others)]
    return float(np.sqrt((miss**2).mean()))


def beside_a_sliver(ratio: float, method: str = "the default") -> float:
    """Rms of log10 of the entries of all other vertices, where one that no camera saw lies 1 / ratio beside another."""
    own = ball(2, 80, 0.0)
    mesh, values = sliver_ball(ratio), own.samples.values.copy()
    moved = np.flatnonzero((np.asarray(mesh.vertices) != own.samples.mesh.vertices).any(axis=1))
    values[:, :, moved] = np.nan
    found = entries(replace(own.samples, mesh=mesh, values=values), method)
    others = np.setdiff1d(np.arange(len(found)), moved)
    at = np.ix_(others, others)
    return float(np.sqrt((np.log10(np.where(found > 0, found, np.nan) / own.truth[0])[at] ** 2).mean()))


for ratio in (1e-3, 1e-6):
    FAMILY.case(
        f"a scan whose edges differ by {1 / ratio:.0e}",
        "log10 of the other entries within .06 rms",
        f"edge lengths 1 : {1 / ratio:.0e}",
        0.06,
        slow=True,
        rivals={"disco2004": partial(beside_a_sliver, ratio, "disco2004")},
    )(partial(beside_a_sliver, ratio))


# ---------------------------------------------------------------- the smooth field
def dense(field: SymmetricField, target: F64, weight: F64, scale: F64) -> F64:
    """The field by the dense normal equations in double precision."""
    n = field.penalty.shape[0]
    upper = [(i, j) for i in range(n) for j in range(i, n)]
    vertices, spots = field.vertices.astype(np.float64), field.spots.astype(np.float64)
    columns = []
    for i, j in upper:
        y = np.zeros((n, n))
        y[i, j] = y[j, i] = 1.0
        columns.append((scale * ((spots @ y) @ vertices.T)).ravel())
    design = np.stack(columns, axis=1)
    own = np.array([field.penalty[i, j] * (1 if i == j else 2) for i, j in upper], np.float64)
    root = np.sqrt(weight.ravel())
    stacked = np.concatenate([design * root[:, None], np.diag(np.sqrt(own))])
    right = np.concatenate([target.ravel() * root, np.zeros(len(own))])
    x = np.linalg.lstsq(stacked, right, rcond=None)[0]
    y = np.zeros((n, n))
    for (i, j), value in zip(upper, x, strict=True):
        y[i, j] = y[j, i] = value
    return np.asarray((spots @ y) @ vertices.T)


def solved(decades: float) -> float:
    """Largest difference of the field from the dense solution's where it was observed, over the field's deviation."""
    mesh, rng = trimesh.creation.icosphere(subdivisions=1), np.random.default_rng(2)
    basis = harmonics(mesh, 12)
    to_spots = sparse.csr_array(RayMesh.of(mesh).interpolation(np.arange(0, 80, 8), np.full((10, 3), 1 / 3)))
    field = SymmetricField.of(basis, to_spots, 0.6)
    shape = (10, len(mesh.vertices))
    target, weight = rng.standard_normal(shape), 10.0 ** rng.uniform(2 - decades, 2, shape)
    scale = np.full(shape, 0.3)
    y = field.solve(target, weight, scale, np.zeros_like(field.penalty))
    exact = dense(field, target, weight, scale)
    return float(np.sqrt(((field.at_spots(y) - exact) ** 2).mean() / (exact**2).mean()))


for decades in (0.0, 6.0, 12.0):
    FAMILY.case(
        f"the smooth field, weights over {decades:g} decades",
        "the dense normal equations in double precision",
        f"weights 1e{2 - decades:g} .. 100",
        0.02,
    )(partial(solved, decades))


def sliver_ball(ratio: float) -> trimesh.Trimesh:
    """A ball one of whose vertices lies `ratio` edges from its neighbour: edge lengths differ by 1 / ratio."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=10.0)
    points = np.array(mesh.vertices)
    a, b = mesh.edges_unique[0]
    points[a] = points[b] + ratio * (points[a] - points[b])
    return trimesh.Trimesh(points, mesh.faces, process=False)


def harmonics_off(mesh: trimesh.Trimesh) -> float:
    """By how much the functions miss being orthonormal and the first being constant."""
    basis: Harmonics = harmonics(mesh, 40)
    area = RayMesh.of(mesh).vertex_areas / RayMesh.of(mesh).vertex_areas.sum()
    gram = basis.functions.T @ (basis.functions * area[:, None])
    if not np.isfinite(gram).all() or not np.isfinite(basis.eigenvalues).all():
        return np.nan
    return float(np.abs(gram - np.eye(len(gram))).max() + np.abs(np.abs(basis.functions[:, 0]) - 1).max())


def beside_a_sliver_off(ratio: float) -> float:
    return harmonics_off(sliver_ball(ratio))


for ratio in (1e-3, 1e-6):
    FAMILY.case(
        f"harmonics where edges differ by {1 / ratio:.0e}",
        "orthonormal, the first constant",
        f"edge lengths 1 : {1 / ratio:.0e}",
        1e-3,
        ends=Ends.EITHER,
    )(partial(beside_a_sliver_off, ratio))


@FAMILY.case("harmonics of two balls apart", "orthonormal; two functions without a slope", "2 components", 1e-6)
def components() -> float:
    one = trimesh.creation.icosphere(subdivisions=1, radius=5.0)
    both = trimesh.util.concatenate([one, one.copy().apply_translation([30, 0, 0])])
    basis = harmonics(both, 40)
    area = RayMesh.of(both).vertex_areas / RayMesh.of(both).vertex_areas.sum()
    gram = basis.functions.T @ (basis.functions * area[:, None])
    return float(np.abs(gram - np.eye(len(gram))).max() + abs((basis.eigenvalues < 1e-9).sum() - 2))


@FAMILY.case("a scan with a vertex that no triangle has", "harmonics as without it", "area 0", 1e-3)
def vertex_alone() -> float:
    ball_ = trimesh.creation.icosphere(subdivisions=1, radius=5.0)
    mesh = trimesh.Trimesh(np.vstack([ball_.vertices, [[1.0, 2.0, 3.0]]]), ball_.faces, process=False)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scan.ply"
        mesh.export(path)
        return harmonics_off(read_scan(path))


@FAMILY.case(
    "a second ball that no spot lit",
    "finite entries there, none below 0; the first as without it",
    "an isolated component",
    0.1,
    slow=True,
)
def isolated() -> float:
    own = ball(hidden=0.0)
    mesh = own.samples.mesh
    both = trimesh.util.concatenate([mesh, mesh.copy().apply_translation([40, 0, 0])])
    count = len(mesh.vertices)

    def wider(array: Any, blank: float) -> Any:
        out = np.full((*array.shape[:-1], 2 * count), blank, array.dtype)
        out[..., :count] = array
        return out

    s = own.samples
    samples = replace(
        s,
        mesh=both,
        values=wider(s.values, np.nan),
        dark_variance=wider(s.dark_variance, 0),
        noise_per_signal=wider(s.noise_per_signal, 0),
        oblique=wider(s.oblique, 0),
        tilt=wider(s.tilt, 0),
        cosine=wider(s.cosine, 1),
    )
    found = entries(samples)
    if not (np.isfinite(found).all() and (found >= 0).all()):
        return np.nan
    return float(np.sqrt((np.log10(found[:count, :count] / own.truth[0]) ** 2).mean()))
