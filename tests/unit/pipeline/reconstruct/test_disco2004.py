"""The thesis's resampling and filling, on an object whose R_d is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from reconstruct_synthetic import Synthetic, rmse_log10

from pipeline.reconstruct.baselines.disco2004 import distribute, fill, neighbours, resample_2004
from pipeline.reconstruct.global_term.completion import (
    complete,
)


def test_2004_spots_count_for_their_triangles(small: Synthetic) -> None:
    s = small.samples
    one = replace(s, values=np.where(np.arange(80)[:, None] == 5, s.values, np.nan).astype(np.float32))
    values, known = distribute(one, 0)
    lit = s.mesh.faces[s.spots.triangle[5]]
    assert set(np.flatnonzero(known.any(axis=1))) <= set(lit)
    seen = np.isfinite(s.values[0, 5])
    np.testing.assert_allclose(values[lit[0]][seen], s.values[0, 5][seen], rtol=1e-5)


def test_2004_fill_is_where_the_iteration_ends(small: Synthetic) -> None:
    """Rationale: the explicit iteration of the thesis (5.3.2), in float64 and run until it rests, with the largest
    stable step for the shortest edge, on a mesh with edges of very different length.
    Expected behaviour: the same matrix, symmetric, within its data, measured entries untouched; constants stay.
    """
    mesh = small.samples.mesh.copy()
    mesh.vertices[:20] *= 0.999 + 0.3 * np.random.default_rng(0).random((20, 1))
    laplacian = neighbours(np.asarray(mesh.vertices), np.asarray(mesh.edges_unique))
    rng = np.random.default_rng(2)
    size = len(mesh.vertices)
    known = rng.random((size, size)) < 0.05
    np.fill_diagonal(known, rng.random(size) < 0.5)
    values = np.where(known, rng.random((size, size)), 0.0)
    out = fill(values, known, laplacian)
    count = known.astype(float) + known.T
    iterated = np.where(count > 0, (values + values.T) / np.maximum(count, 1), 0.0)
    step = 0.45 / laplacian.diagonal().max()
    for _ in range(4000):
        change = laplacian @ iterated
        iterated = iterated - np.where(count > 0, 0.0, step * (change + change.T))
    np.testing.assert_allclose(out, iterated, atol=5e-3)
    np.testing.assert_allclose(out, out.T, atol=1e-5)
    assert out.min() >= 0
    assert out.max() <= 1
    only = known & ~known.T
    np.testing.assert_allclose(out[only], values[only])
    np.testing.assert_allclose(fill(np.where(known, 0.5, 0.0), known, laplacian), 0.5, atol=5e-3)


def test_2004_is_the_weaker_method(small: Synthetic) -> None:
    theirs, ours = (fit(small.samples).terms[0].reflectance[0] for fit in (resample_2004, complete))
    assert rmse_log10(np.maximum(theirs, 1e-9), small.truth[0]) > 2 * rmse_log10(ours, small.truth[0])
