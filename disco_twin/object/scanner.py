"""The laser range scanner of the twin: points on the object's surface, off by what thesis figure 4.8 shows.

A bare translucent object is seen too deep, by about a free path, and noisily: the light of the scanner's stripe leaves
below the surface (Godin et al. 2001). So it is sprayed: the coat ends that, and leaves its own thickness.
"""

from __future__ import annotations

import numpy as np
import trimesh

from disco_twin.faults.light_faults import Stream, generator
from hw.base.arrays import F64

POINTS = 40_000
NOISE_MM, COAT_MM = 0.05, 0.02  # of single points; thickness of the spray
ERROR_MM, ERROR_LENGTH_MM, LARGEST_MM = 0.1, 10.0, 0.3  # geometry error: rms, correlation length, bound (thesis 4.4)
WAVES = 256


def scan_points(mesh: trimesh.Trimesh, seed: int) -> tuple[F64, F64]:
    """(N, 3) points in mm and (N, 3) unit normals."""
    rng = generator(seed, Stream.SCANNER)
    points, face = trimesh.sample.sample_surface_even(mesh, POINTS, seed=int(rng.integers(2**31)))
    normals = np.asarray(mesh.face_normals)[face]
    error = np.clip(geometry_error(points, rng), -LARGEST_MM, LARGEST_MM)
    error += NOISE_MM * rng.standard_normal(len(points))
    error += COAT_MM
    return np.asarray(points + error[:, None] * normals), normals


def geometry_error(points: F64, rng: np.random.Generator) -> F64:
    """(N,) mm, a smooth random field: waves whose spectrum is that of a Gaussian correlation."""
    wave = rng.standard_normal((WAVES, 3)) * np.sqrt(2.0) / ERROR_LENGTH_MM
    phase = rng.uniform(0, 2 * np.pi, WAVES)
    return np.asarray(ERROR_MM * np.sqrt(2.0 / WAVES) * np.cos(points @ wave.T + phase).sum(axis=1))
