"""The same ball of light for three programs: the walk, stock Mitsuba's `volpath`, and pmmc on a tetrahedral mesh.

A ball of 20 mm, 20 480 triangles, index 1.3, sigma_t of 1.5 to 2.5/mm on 32^3 voxels (trilinear), albedo .995, even
scattering: some 80 collisions a walk. pmmc (Fang 2010) knows neither rough boundaries nor voxels: it gets a smooth
boundary and one of 64 media for each tetrahedron of a voxel's size. The ball is convex, so that the Delaunay
tetrahedra of its vertices and of points inside have its very surface.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.metadata
import io
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import Delaunay

from disco_twin.object.build import Medium, TwinBoundary, TwinObject

RADIUS, VOXELS, ALBEDO, ETA, LEVELS = 20.0, 32, 0.995, 1.3, 64
ROULETTE, SURVIVORS = 0.1, 2  # below this weight one of so many survives, in the walk and in pmmc


def ball(kind: str = "rough") -> TwinObject:
    """The ball; its boundary is rough (alpha .3) for the comparison of speed, smooth for that of absorbed power."""
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    sigma_t = 2.0 * np.random.default_rng(0).uniform(0.75, 1.25, (1, VOXELS, VOXELS, VOXELS)).astype(np.float32)
    medium = Medium(sigma_t, np.full_like(sigma_t, ALBEDO), np.full(3, -RADIUS), np.full(3, RADIUS), (0.0,))
    boundary = TwinBoundary("rough", ETA, 0.3) if kind == "rough" else TwinBoundary("smooth", ETA, 0.0)
    return TwinObject(mesh, boundary, medium)


def tetrahedra(
    obj: TwinObject,
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    """Nodes (N, 3), tetrahedra (T, 4) from 1, the medium of each (T,) from 1, and the media's (LEVELS + 1, 4) rows of
    mu_a, mu_s in 1/mm, g, index; row 0 is the outside.
    """
    step = 2 * RADIUS / VOXELS
    axis = (np.arange(VOXELS) + 0.5) * step - RADIUS
    inner = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    inner = (
        inner + np.random.default_rng(1).uniform(-0.2, 0.2, inner.shape) * step
    )  # a perfect grid has flat tetrahedra
    inner = inner[np.linalg.norm(inner, axis=1) < RADIUS - 0.6 * step]
    nodes = np.concatenate([np.asarray(obj.mesh.vertices), inner])
    cells = Delaunay(nodes).simplices.astype(np.int32)
    a, b, c, d = (nodes[cells[:, k]] for k in range(4))
    left = np.einsum("ij,ij->i", b - a, np.cross(c - a, d - a)) < 0
    cells[left] = cells[left][:, [0, 2, 1, 3]]
    sigma_t = obj.medium.sigma_t[0].astype(float)
    grid = (nodes[cells].mean(axis=1) + RADIUS) / step - 0.5
    found = ndimage.map_coordinates(sigma_t, grid[:, ::-1].T, order=1, mode="nearest")
    edges = np.linspace(sigma_t.min(), sigma_t.max(), LEVELS + 1)
    medium = np.clip(np.digitize(found, edges), 1, LEVELS).astype(np.int32)
    middle = (edges[1:] + edges[:-1]) / 2
    rows = np.stack([middle * (1 - ALBEDO), middle * ALBEDO, 0 * middle, 0 * middle + ETA], axis=1)
    return nodes, cells + 1, medium, np.concatenate([[[0, 0, 1, 1]], rows]).astype(np.float32)


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Nothing reaches the terminal, not even from C: pmmc prints a page at every call."""
    sys.stdout.flush()
    kept, nowhere = [os.dup(1), os.dup(2)], os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            yield
    finally:
        ctypes.CDLL(None).fflush(None)  # what C has not written yet
        for stream, old in zip((1, 2), kept, strict=True):
            os.dup2(old, stream)
            os.close(old)
        os.close(nowhere)


class Pmmc:
    """pmmc with its fastest ray tracer for CPUs; ImportError where it, or an OpenCL that it looks for, is missing."""

    def __init__(self, obj: TwinObject) -> None:
        self.folder = tempfile.TemporaryDirectory()
        files = importlib.metadata.files("pocl-binary-distribution") or []
        library = [str(Path(str(f.locate())).resolve()) for f in files if "libpocl" in f.name]
        if not library:
            raise ImportError(
                "pmmc runs on the CPU only where it finds an OpenCL: pip install pocl-binary-distribution"
            )
        # The wheel's own entry names its library without a folder.
        (Path(self.folder.name) / "pocl.icd").write_text(library[0])
        os.environ["OCL_ICD_VENDORS"] = self.folder.name
        with silence():
            import pmmc
        self.module = pmmc
        nodes, cells, medium, rows = tetrahedra(obj)
        self.cells = len(cells)
        self.settings: dict[str, Any] = {
            "node": nodes, "elem": cells, "elemprop": medium, "prop": rows, "tstart": 0, "tend": 1e-6, "tstep": 1e-6,
            "srcpos": [0.1, 0.07, RADIUS - 0.02], "srcdir": [0, 0, -1], "isreflect": 1, "issavedet": 0, "issaveexit": 0,
            "minenergy": ROULETTE, "roulettesize": SURVIVORS, "method": "elem", "outputtype": "energy",
            "isnormalized": 0, "compute": "sse",
        }  # fmt: skip

    def absorbed(self, walks: int, seed: int) -> float:
        """The share of the power that enters which is absorbed."""
        with silence():
            made = self.module.run({**self.settings, "nphoton": walks, "seed": seed + 1})
        return float(np.asarray(made["flux"]).sum()) / walks
