"""The truth: exitance per irradiance from photons of its own; the pipeline never sees it.

M(u, v) = power that leaves over the hat function of vertex v / (its area * power that arrives over that of vertex u),
in mm^-2, for light that arrives from all directions alike (Lambertian): cosine in, cosine out is what is reciprocal. No
index is in it. A model's own is Tbar^2 R_d (`RelightableModel.exitance_columns`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from scipy import sparse

from disco_twin.light.balance import EnergyBalance
from hw.base.arrays import F32, F64, I64
from hw.base.files import load_arrays, save_arrays
from pipeline.geometry.mesh import RayMesh

if TYPE_CHECKING:
    from disco_twin.light.transport import Transport


REPLICATES = 8
ENTRIES = 256  # places that stand for a hat function in its weight windows
FORMAT_VERSION = 3
ARRAYS = ("columns", "replicates", "area")


@dataclass(frozen=True)
class Truth:
    """Columns of M on the scan's vertices.

    columns: (n,) vertices; replicates: (R, L, n, V) in mm^-2 (index: replicate, laser, lit vertex, seen vertex),
    independent of each other; area: (V,) integral of each hat function in mm^2; balance: where light went.
    """

    columns: I64
    replicates: F32
    area: F64
    balance: EnergyBalance

    @cached_property
    def mean(self) -> F64:
        """(L, n, V) mm^-2."""
        return self.replicates.mean(axis=0, dtype=np.float64)

    @cached_property
    def standard_error(self) -> F64:
        """(L, n, V) mm^-2, of `mean`."""
        return standard_error(self.replicates)

    def save(self, path: Path) -> None:
        """Write an .npz, replacing any older one at once."""
        balance = {f"balance_{k}": getattr(self.balance, k) for k in EnergyBalance.__dataclass_fields__}
        save_arrays(path, FORMAT_VERSION, {name: getattr(self, name) for name in ARRAYS} | balance)

    @classmethod
    def load(cls, path: Path) -> Truth:
        """Read what `save` wrote. Raises: InputError for a missing or damaged file, and for another format version."""
        names = (*ARRAYS, *(f"balance_{k}" for k in EnergyBalance.__dataclass_fields__))
        _, data = load_arrays(path, FORMAT_VERSION, "disco-twin run computes it again once it is deleted", names)
        balance = EnergyBalance(**{k: data[f"balance_{k}"] for k in EnergyBalance.__dataclass_fields__})
        return cls(data["columns"], data["replicates"], data["area"], balance)


def standard_error(replicates: F32 | F64) -> F64:
    """(R, ...) independent replicates -> (...) standard error of their mean."""
    return np.asarray(replicates.std(axis=0, ddof=1, dtype=np.float64) / np.sqrt(len(replicates)))


def hat_areas(transport: Transport, basis: sparse.csr_matrix) -> F64:
    """(V,) integral over the fine mesh of each scan vertex's hat function, mm^2."""
    return np.asarray(basis.T @ RayMesh.of(transport.object.mesh).vertex_areas)


def places_of(hats: F64, mesh: trimesh.Trimesh) -> F64:
    """(n, ENTRIES, 3) places, alike, over which the functions (n, V) at the fine mesh's vertices are spread."""
    share = np.cumsum(hats * RayMesh.of(mesh).vertex_areas, axis=1)
    steps = (np.arange(ENTRIES) + 0.5) / ENTRIES
    return np.stack([np.asarray(mesh.vertices)[np.searchsorted(row, steps * row[-1])] for row in share])


def truth_columns(transport: Transport, basis: sparse.csr_matrix, columns: I64, walks: int, seed: int) -> Truth:
    """M[u, v] = (escaped power weighted by hat v) / area of v, per watt that arrives over hat u.

    basis: (V_fine, V) the hat functions' values at the vertices of the mesh that light is traced on; walks: a column.
    """
    from disco_twin.light.importance import Splitting
    from disco_twin.light.sources import HatSource  # what is stored can be read without a renderer

    hats = np.repeat(basis[:, columns].toarray().T, REPLICATES, axis=0)
    entries = places_of(hats, transport.object.mesh)
    replicate = np.tile(np.arange(REPLICATES), len(columns))
    names = (np.repeat(columns, REPLICATES) * REPLICATES + replicate).astype(np.uint32)
    per_replicate = max(1, round(walks / REPLICATES))
    traced = transport.trace(
        lambda group: HatSource(transport.vertices, transport.faces, hats, len(group)),
        len(hats), per_replicate, seed=seed, streams=names, deposit=True, split=Splitting(entries),
    )  # fmt: skip
    assert traced.deposits is not None
    n, lasers = len(columns), transport.lasers
    power = np.stack([(basis.T @ deposit.T).T for deposit in traced.deposits])  # (n * replicates, L, V)
    area = hat_areas(transport, basis)
    exitance = power.reshape(n, REPLICATES, lasers, -1).transpose(1, 2, 0, 3) / area
    return Truth(np.asarray(columns), exitance.astype(np.float32), area, traced.balance)
