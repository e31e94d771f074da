"""Error against time of the flux that a light sends through every vertex of a non-convex mesh.

Truth is the same integral with every setting far finer; the first setting that matters is checked against closed
forms and brute force in tests/unit/test_relight_irradiance.py. Error: root mean square over the vertices of the hat
moments relative to their root mean square.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np
import trimesh

from pipeline.relight.irradiance import Accuracy, hat_moments
from pipeline.relight.lights import shipped_lights

ETA, LASERS = 1.3, 3


def dented(subdivisions: int) -> trimesh.Trimesh:
    """A sphere of 20 mm with dents deep enough to shade themselves; 10 * 4^n + 2 vertices."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    x, y, z = ball.vertices.T
    radius = 20 * (1 + 0.14 * np.sin(4 * x + 1) * np.sin(3 * y) + 0.12 * np.cos(5 * z + 2 * x))
    return trimesh.Trimesh(ball.vertices * radius[:, None], ball.faces, process=False)


def run(quick: bool = False) -> dict[str, Any]:
    """Curves {name, points: [{seconds, seconds_min, seconds_max, error, settings}]}, one a light."""
    mesh = dented(3 if quick else 4)
    repetitions = 3 if quick else 5
    fine = Accuracy(1e-6, 9, 2048) if quick else Accuracy(1e-6, 11, 8192)
    sharp = [Accuracy(tolerance, 10) for tolerance in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)]
    broad = [Accuracy(directions=n) for n in (16, 64, 256, 1024)]
    curves = []
    for light in shipped_lights((150.0, 400.0, 110.0)):
        truth = hat_moments(light, mesh, ETA, LASERS, fine)
        points = []
        for setting in broad if light.kind in ("uniform", "environment") else sharp:
            seconds = []
            for _ in range(repetitions):
                start = time.perf_counter()
                moments = hat_moments(light, mesh, ETA, LASERS, setting)
                seconds.append(time.perf_counter() - start)
            error = float(np.sqrt(((moments - truth) ** 2).sum() / (truth**2).sum()))
            points.append(
                {
                    "seconds": statistics.median(seconds),
                    "seconds_min": min(seconds),
                    "seconds_max": max(seconds),
                    "error": error,
                    "settings": {"tolerance": setting.tolerance, "directions": setting.directions},
                }
            )
        curves.append({"name": light.name, "points": points})
    return {"name": "irradiance", "quick": quick, "vertices": len(mesh.vertices), "curves": curves}
