"""The reconstructed object: R_d on the scan's vertices, with variance, units and provenance, in one file."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

import numpy as np
import trimesh
from numpy.typing import NDArray

from hw.base.errors import InputError
from pipeline.geometry.fresnel import Boundary

F32 = NDArray[np.float32]

FORMAT_VERSION = 1
UNITS = {"vertices": "mm", "reflectance": "mm^-2", "variance": "mm^-4"}
_ARRAYS = ("vertices", "faces", "reflectance", "variance", "measured")


@dataclass(frozen=True)
class ReflectanceModel:
    """Diffuse subsurface reflectance.

    mesh: V vertices, mm; reflectance: (L, V_in, V_out) mm^-2, symmetric, mean over both hat functions;
    variance: same shape; measured: (V, V) entries that an observed spot near one vertex and the other one support;
    boundary: assumed index and, if it was measured, how its transmittance departs from the smooth one;
    provenance: how it came about (method, settings)
    """

    mesh: trimesh.Trimesh
    reflectance: F32
    variance: F32
    measured: NDArray[np.bool_]
    boundary: Boundary
    provenance: Mapping[str, str]

    def radiosity(self, flux: NDArray[np.float64]) -> NDArray[np.float64]:
        """(L, V) transmitted flux in W per vertex -> (L, V) radiosity in W/mm^2 (thesis 5.3: B = E F)."""
        return np.stack([q @ r for q, r in zip(flux, self.reflectance, strict=True)])

    def save(self, path: Path) -> None:
        """Write an .npz, replacing any older one at once."""
        head = {
            "format_version": FORMAT_VERSION,
            "units": UNITS,
            "boundary": asdict(self.boundary),
            "provenance": dict(self.provenance),
        }
        partial = path.with_suffix(".part")
        with partial.open("wb") as file:
            np.savez(
                file,
                head=np.array(json.dumps(head)),
                vertices=np.asarray(self.mesh.vertices, np.float64),
                faces=np.asarray(self.mesh.faces, np.int64),
                reflectance=self.reflectance,
                variance=self.variance,
                measured=self.measured,
            )
        os.replace(partial, path)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote; anything else is refused in one line."""
        remedy = "reconstruct again with this version"
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
                head = json.loads(str(data["head"]))
                arrays = {name: data[name] for name in _ARRAYS}
        except OSError as error:
            raise InputError(f"cannot be read ({error.strerror or error})", file=path, remedy=remedy) from error
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(f"not a reflectance model ({error})", file=path, remedy=remedy) from error
        if not isinstance(head, dict) or head.get("format_version") != FORMAT_VERSION:
            found = head.get("format_version") if isinstance(head, dict) else None
            raise InputError(
                "another format version", file=path, key="format_version", value=found, allowed="1", remedy=remedy
            )
        if head.get("units") != UNITS:
            raise InputError("unknown units", file=path, key="units", value=head.get("units"), remedy=remedy)
        _check(path, arrays)
        mesh = trimesh.Trimesh(arrays["vertices"], arrays["faces"], process=False)
        b = head["boundary"]
        boundary = Boundary(float(b["eta"]), tuple(b["cosines"]), tuple(b["ratio"]))
        return cls(mesh, arrays["reflectance"], arrays["variance"], arrays["measured"], boundary, head["provenance"])


def _check(path: Path, arrays: Mapping[str, NDArray[np.generic]]) -> None:
    vertices, reflectance = len(arrays["vertices"]), arrays["reflectance"]
    square = reflectance.ndim == 3 and reflectance.shape[1:] == (vertices, vertices)
    if not square or arrays["variance"].shape != reflectance.shape or arrays["measured"].shape != (vertices, vertices):
        raise InputError(
            "arrays do not fit each other", file=path, key="reflectance", value=reflectance.shape,
            allowed=f"(lasers, {vertices}, {vertices})", remedy="reconstruct again",
        )  # fmt: skip
    if not np.isfinite(reflectance.astype(np.float64)).all():
        raise InputError("holds values that are not finite", file=path, key="reflectance", remedy="reconstruct again")
