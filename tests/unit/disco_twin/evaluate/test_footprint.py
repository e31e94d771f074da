"""Where a beam's light enters for exact samples."""

from __future__ import annotations

import numpy as np
import trimesh

from disco_twin.evaluate.exact_light import _footprint
from pipeline.reconstruct.samples.spots import Spots


def test_a_beam_enters_on_one_side_of_a_thin_wall() -> None:
    """Rationale: a plate thinner than the reach that folds of a surface are given; the beam comes from above."""
    plate = trimesh.creation.box((20.0, 20.0, 1.0))
    for _ in range(5):
        plate = plate.subdivide()
    down = np.array([[0.0, 0.3, -1.0]]) / np.hypot(0.3, 1.0)
    top = np.array([[0.0, 0.0, 0.5]])
    one = np.ones((1, 3)) / 3
    spots = Spots(top, down, np.array([[0.0, 0.0, 1.0]]), np.zeros(1, np.int64), one, np.ones(1), 1.5)
    vertices = np.asarray(plate.vertices)
    lit = _footprint(vertices, np.asarray(plate.vertex_normals), spots, 0) > 0
    assert lit.sum() >= 12
    np.testing.assert_allclose(vertices[lit, 2], 0.5)
