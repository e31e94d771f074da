"""Irradiance without the boundary, to compare lights with what they are by definition."""

from __future__ import annotations

import trimesh

from hw.base.arrays import F64, I64
from pipeline.geometry.mesh import RayMesh
from pipeline.relight.irradiance import received
from pipeline.relight.lights import Light


def irradiance(light: Light, mesh: trimesh.Trimesh, face: I64, points: F64, lasers: int) -> F64:
    """(L, N) W/mm^2 at (N, 3) points on (N,) faces; shadows of the mesh included."""
    return received(RayMesh.of(mesh), light, face, points, 1.0, lasers, directions=1024)
