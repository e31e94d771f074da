"""Ground-truth R_d from photons of its own (docs/conventions.md, "R_d"); the pipeline never sees it.

Photons are launched cosine-weighted over the hat function of vertex u, their escaped power is weighted by the hat
function of vertex v: cosine in, cosine out, which is what is reciprocal.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from disco_twin.light.balance import EnergyBalance
from hw.base.arrays import F64, I64
from hw.base.files import load_arrays, save_arrays
from pipeline.geometry.fresnel import mean_transmittance
from pipeline.geometry.mesh import RayMesh

if TYPE_CHECKING:
    from disco_twin.light.transport import Transport


REPLICATES = 8
FORMAT_VERSION = 2
ARRAYS = ("columns", "mean", "standard_error", "area")


@dataclass(frozen=True)
class Truth:
    """Columns of R_d on the scan's vertices.

    columns: (n,) vertices; mean, standard_error: (L, n, V) in mm^-2 (index: laser, lit vertex, seen vertex), from
    `REPLICATES` independent replicates; area: (V,) integral of each hat function in mm^2; balance: where light went.
    """

    columns: I64
    mean: F64
    standard_error: F64
    area: F64
    balance: EnergyBalance

    def save(self, path: Path) -> None:
        """Write an .npz, replacing any older one at once."""
        balance = {f"balance_{k}": getattr(self.balance, k) for k in EnergyBalance.__dataclass_fields__}
        save_arrays(path, FORMAT_VERSION, {name: getattr(self, name) for name in ARRAYS} | balance)

    @classmethod
    def load(cls, path: Path) -> Truth:
        """Read what `save` wrote. Raises: InputError for a missing or damaged file, and for another format version."""
        names = (*ARRAYS, *(f"balance_{k}" for k in EnergyBalance.__dataclass_fields__))
        _, data = load_arrays(path, FORMAT_VERSION, "delete it, disco-twin run computes it again", names)
        balance = EnergyBalance(**{k: data[f"balance_{k}"] for k in EnergyBalance.__dataclass_fields__})
        return cls(data["columns"], data["mean"], data["standard_error"], data["area"], balance)


def hat_areas(transport: Transport, basis: sparse.csr_matrix) -> F64:
    """(V,) integral over the fine mesh of each scan vertex's hat function, mm^2."""
    return np.asarray(basis.T @ RayMesh.of(transport.object.mesh).vertex_areas)


def truth_columns(transport: Transport, basis: sparse.csr_matrix, columns: I64, walks: int, seed: int) -> Truth:
    """R_d[u, v] = (escaped power weighted by hat v) / (area of v * Tbar^2) per watt that falls on hat u.

    basis: (V_fine, V) the hat functions' values at the vertices of the mesh that light is traced on; walks: a column.
    """
    from disco_twin.light.importance import Splitting
    from disco_twin.light.sources import HatSource  # what is stored can be read without a renderer

    hats = np.repeat(basis[:, columns].toarray().T, REPLICATES, axis=0)
    entries = (hats @ transport.vertices) / hats.sum(axis=1, keepdims=True)

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
    both = mean_transmittance(transport.object.boundary.eta) ** 2
    reflectance = power.reshape(n, REPLICATES, lasers, -1).transpose(1, 2, 0, 3) / (area * both)
    error = reflectance.std(axis=0, ddof=1) / np.sqrt(REPLICATES)
    return Truth(np.asarray(columns), reflectance.mean(axis=0), error, area, traced.balance)
