"""A synthetic object whose R_d is known, and its samples: no renderer, no images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from pipeline.geometry.mesh import RayMesh
from pipeline.reconstruct.samples.distances import vertex_pairs
from pipeline.reconstruct.samples.samples import Samples
from pipeline.reconstruct.samples.spots import Spots

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Synthetic:
    """samples and the truth (L, V, V) mm^-2 that they were drawn from."""

    samples: Samples
    truth: F64


def kernel(distance: F64, length: float) -> F64:
    """R_d against distance: a narrow and a wide exponential, mm^-2."""
    return np.asarray(0.03 * np.exp(-distance / 0.8) + 0.004 * np.exp(-distance / length))


def make(
    subdivisions: int = 2, spots: int = 80, noise: float = 0.02, contrast: float = 0.3, seed: int = 0, lasers: int = 1,
    length: float = 4.0, hidden: float = 0.3,
) -> Synthetic:  # fmt: skip
    """A sphere of 10 mm with R_d = a(x) a(y) f(|x - y|), log a smooth with amplitude `contrast`.

    noise: relative error of a sample; hidden: share of the surface that no camera sees at a time.
    """
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=10.0)
    points = np.asarray(mesh.vertices)
    log_a = contrast * np.sin(points[:, 0] / 4.0 + 1.0) * np.cos(points[:, 2] / 5.0)
    triangle = rng.permutation(len(mesh.faces))[:spots]
    barycentric = rng.dirichlet(np.ones(3), spots)
    surface = RayMesh.of(mesh)
    position, normal = surface.points(triangle, barycentric), surface.smooth_normals(triangle, barycentric)
    where = Spots(position, -normal, normal, triangle, barycentric, np.full(spots, 0.98), 1.0)
    to_spots = surface.interpolation(triangle, barycentric)
    empty = np.full((lasers, spots, len(points)), np.nan, np.float32)
    level = np.zeros((spots, len(points)))
    facing = np.ones_like(level, np.float32)
    bare = Samples(mesh, 1.3, where, empty, empty, empty, level.astype(np.float32), level, facing)
    values, truths = [], []
    for laser in range(lasers):

        def f(d: F64, laser: int = laser) -> F64:
            return kernel(d, length - 0.5 * laser)

        exact = bare.spot_pairs.mean(f) * np.exp((to_spots @ log_a)[:, None] + log_a)
        values.append(exact * (1 + noise * rng.standard_normal(exact.shape)))
        truths.append(vertex_pairs(mesh).mean(f) * np.exp(log_a[:, None] + log_a))
    value = np.stack(values)
    turned = rng.standard_normal((3, 3))  # as from three turntable angles: each third of the spots has a blind side
    for group, towards in enumerate(turned):
        depth = points @ towards
        blind = depth < np.quantile(depth, hidden) if hidden else np.zeros(len(points), bool)
        value[:, group::3, blind] = np.nan
    slope = noise**2 * np.nan_to_num(value)
    samples = Samples(
        mesh,
        1.3,
        where,
        value.astype(np.float32),
        np.zeros_like(value, np.float32),
        slope.astype(np.float32),
        level.astype(np.float32),
        level,
        facing,
    )
    truth = np.stack(truths)
    return Synthetic(samples, 0.5 * (truth + truth.transpose(0, 2, 1)))


@pytest.fixture(scope="session")
def small() -> Synthetic:
    """The sphere with 80 spots; not to be changed."""
    return make(subdivisions=2, spots=80)


def rmse_log10(model: F64, truth: F64) -> float:
    """Root mean square of log10(model / truth)."""
    return float(np.sqrt((np.log10(model / truth) ** 2).mean()))
