"""First angular moments of what leaves, by direction of entry: the truth that the angular term is scored against.

Light arrives over a hat function as for the truth (Lambertian). With d the part along the surface of the direction in
which it arrives, |d| = sin(theta), and a fixed unit axis a,

    T(u, a, v) = mean of (d . a) power that leaves over hat v / (area of v * power that arrives over hat u)   [mm^-2]

beside M(u, v), the same without (d . a). What leaves ahead of where it entered makes T positive for vertices that lie
along a. No index is in it, and no model.

One photon carries all three: wavelengths of one walk may differ in their weights, so a walk through three copies of one
wavelength's medium, launched with 1, 1 + d . a and 1 + d . b, has M in the first and the moments in the differences,
without noise of their own between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from disco_twin.light.truth import REPLICATES, hat_areas, places_of
from disco_twin.object.build import TwinObject
from hw.base.arrays import F32, F64, I64
from hw.base.files import load_arrays, save_arrays

if TYPE_CHECKING:
    from disco_twin.light.transport import Transport

FORMAT_VERSION = 1
ARRAYS = ("laser", "columns", "axes", "tangent", "plain", "along")


@dataclass(frozen=True)
class Moments:
    """Moments of one laser's light on the scan's vertices.

    laser: () its index; columns: (n,) vertices u that are lit; axes: (n, 2, 3) the axes a, unit, across the hat's mean
    normal; tangent: (n, 3, 3) mean of 1 - n n^T over the hat; plain: (R, n, V) M and along: (R, 2, n, V) T, by
    independent replicates, in mm^-2
    """

    laser: I64
    columns: I64
    axes: F64
    tangent: F64
    plain: F32
    along: F32

    @cached_property
    def mean(self) -> F64:
        """(n, V) M in mm^-2."""
        return self.plain.mean(axis=0, dtype=np.float64)

    def save(self, path: Path) -> None:
        """Write an .npz, replacing any older one at once."""
        save_arrays(path, FORMAT_VERSION, {name: getattr(self, name) for name in ARRAYS})

    @classmethod
    def load(cls, path: Path) -> Moments:
        """Read what `save` wrote. Raises: InputError for a missing or damaged file, and for another format version."""
        _, data = load_arrays(path, FORMAT_VERSION, "disco-twin run computes it again once it is deleted", ARRAYS)
        return cls(**{name: data[name] for name in ARRAYS})


def copies_of_one_laser(obj: TwinObject, laser: int) -> TwinObject:
    """The object with three wavelengths that are all this one."""
    return obj.of_lasers([laser] * 3)


def moments(transport: Transport, basis: sparse.csr_matrix, columns: I64, laser: int, walks: int, seed: int) -> Moments:
    """The moments of light that arrives over the hats of these vertices.

    transport: through `copies_of_one_laser`, whose index in the scene is `laser`; basis: (V_fine, V) hat functions;
    walks: a column
    """
    from disco_twin.light.importance import Splitting
    from disco_twin.light.tilted_source import TiltedHatSource  # what is stored can be read without a renderer

    hats = basis[:, columns].toarray().T
    tangent, axes = _frames(transport, hats)
    entries = places_of(hats, transport.object.mesh)
    replicate = np.tile(np.arange(REPLICATES), len(columns))
    names = (np.repeat(columns, REPLICATES) * REPLICATES + replicate).astype(np.uint32)
    hats, entries, ways = (np.repeat(x, REPLICATES, axis=0) for x in (hats, entries, axes))
    traced = transport.trace(
        lambda _: TiltedHatSource(transport.vertices, transport.faces, hats, ways),
        len(hats), max(1, round(walks / REPLICATES)), seed=seed, streams=names, deposit=True, split=Splitting(entries),
    )  # fmt: skip
    assert traced.deposits is not None
    power = np.stack([(basis.T @ deposit.T).T for deposit in traced.deposits])  # (n * replicates, 3, V)
    exitance = power.reshape(len(columns), REPLICATES, 3, -1).transpose(1, 2, 0, 3) / hat_areas(transport, basis)
    plain = exitance[:, 0]
    return Moments(
        np.asarray(laser), np.asarray(columns), axes, tangent,
        plain.astype(np.float32), (exitance[:, 1:] - plain[:, None]).astype(np.float32),
    )  # fmt: skip


def _frames(transport: Transport, hats: F64) -> tuple[F64, F64]:
    """(n, 3, 3) mean of 1 - n n^T over each of (n, V) hats, and (n, 2, 3) axes across its mean normal."""
    corners = transport.vertices[transport.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    normal = across / area[:, None]
    share = hats[:, transport.faces].sum(axis=2) * area
    share /= share.sum(axis=1, keepdims=True)
    tangent = np.eye(3) - np.einsum("nf,fx,fy->nxy", share, normal, normal)
    mean = share @ normal
    # The two directions that are least along the mean normal: the other singular vectors of it.
    axes = np.linalg.svd(mean[:, None, :])[2][:, 1:]
    return tangent, axes
