"""The reconstructed object: a mesh, its boundary, and terms whose radiances add up; in one file without pickle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import trimesh
from numpy.typing import NDArray

from hw.base.arrays import F32, F64
from hw.base.config import in_words
from hw.base.errors import InputError
from hw.base.files import load_arrays, save_arrays
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.mesh import RayMesh
from pipeline.model.factorised import FactorisedTerm
from pipeline.model.lambertian import LambertianTerm
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.term import ReflectanceColumns, Term
from pipeline.relight.lights import Light
from pipeline.relight.on_mesh import LightOnMesh, ViewOfMesh

FORMAT_VERSION = 2
WITHOUT = "without "  # in a provenance, before the name of what a method left out; the value is the reason
KINDS: Mapping[str, type[Term]] = {term.kind: term for term in (GlobalTerm, LambertianTerm, FactorisedTerm)}
REMEDY = "reconstruct again with this version"
FARTHEST_MM = 1e6


@dataclass(frozen=True)
class RelightableModel:
    """mesh: V vertices, mm; boundary: assumed index and, if it was measured, how its transmittance departs from the
    smooth one; terms: what adds up, in this order; provenance: how the model came about

    Raises: ValueError where the terms do not fit the mesh or each other.
    """

    mesh: trimesh.Trimesh
    boundary: Boundary
    terms: tuple[Term, ...]
    provenance: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.terms:
            raise ValueError("a model needs at least one term")
        for term in self.terms:
            term.check(self.lasers, len(self.mesh.vertices))

    @property
    def lasers(self) -> int:
        """Number of wavelengths."""
        return self.terms[0].lasers

    def lit_by(self, light: Light) -> LightOnMesh:
        """A light on this model's surface. Models with the same mesh, boundary and number of lasers can share it."""
        return LightOnMesh(light, self.mesh, self.boundary, self.lasers)

    def seen_by(self, camera: PinholeCamera) -> ViewOfMesh:
        """A camera's view of this model's surface. Models with the same mesh and boundary can share it."""
        return ViewOfMesh(camera, self.mesh, self.boundary)

    def prepare(self, lights: Sequence[LightOnMesh]) -> None:
        """Work out together what images under several lights need; quicker than one after the other."""
        for term in self.terms:
            term.prepare(lights)

    def image(self, light: LightOnMesh, view: ViewOfMesh) -> F32:
        """(L, H, W) radiance in W/(mm^2 sr), averaged over each pixel.

        Raises: ValueError where light or view were prepared for another surface, or the light for other lasers.
        """
        self._require_own(light, view)
        # Where a term for near light and the global term describe the same entries, the shares that split R_d between
        # them (a partition of unity over distance, so that no energy counts twice) belong here, beside the sum.
        total = self.terms[0].image(light, view)
        for term in self.terms[1:]:
            total = total + term.image(light, view)
        return total

    def image_variance(self, light: LightOnMesh, view: ViewOfMesh) -> F32 | None:
        """(2, L, H, W) variance of `image` as the terms state it, for independent errors of R_d's entries and for
        errors that are all alike, between which it lies; None where a term states none. Raises: as `image`.
        """
        self._require_own(light, view)
        parts = [term.image_variance(light, view) for term in self.terms]
        known = [part for part in parts if part is not None]
        if len(known) < len(parts):
            return None
        independent, alike = sum(part[0] for part in known), sum(np.sqrt(part[1]) for part in known) ** 2
        return np.stack([independent, alike]).astype(np.float32)

    def _require_own(self, light: LightOnMesh, view: ViewOfMesh) -> None:
        for prepared in (light, view):
            if prepared.boundary != self.boundary or not _same(prepared.mesh, self.mesh):
                raise ValueError("prepared for another mesh or boundary: use the model's own lit_by and seen_by")
        if light.lasers != self.lasers:
            raise ValueError(f"prepared for {light.lasers} lasers, not {self.lasers}: use the model's own lit_by")

    def reflectance_columns(self, vertices: Sequence[int] | NDArray[np.int64]) -> ReflectanceColumns | None:
        """R_d from these vertices to all; None where no term states any: there is then nothing to score R_d by."""
        parts = [part for term in self.terms if (part := term.reflectance_columns(vertices)) is not None]
        if not parts:
            return None
        total = parts[0]
        for part in parts[1:]:
            both = None if total.variance is None or part.variance is None else total.variance + part.variance
            total = ReflectanceColumns(total.mean + part.mean, both, total.measured | part.measured)
        return total

    def exitance_columns(self, vertices: Sequence[int] | NDArray[np.int64]) -> ReflectanceColumns | None:
        """Tbar^2 R_d in mm^-2, exitance per irradiance under light from all directions; None as `reflectance_columns`.

        Images determine this product alone, not R_d's level and the boundary's apart: what the truth is compared with.
        """
        columns, both = self.reflectance_columns(vertices), self.boundary.mean_transmittance**2
        if columns is None:
            return None
        variance = None if columns.variance is None else columns.variance * both**2
        return ReflectanceColumns(columns.mean * both, variance, columns.measured)

    def leaving(self, vertices: Sequence[int] | NDArray[np.int64], area: F64) -> F64 | None:
        """(L, n, V) share of the light that arrives over the hat functions of these vertices from all directions, and
        leaves over that of every vertex; None where a term does not state it. area: (V,) mm^2 of the hat functions.
        """
        parts = [term.throughput(vertices, area) for term in self.terms]
        known = [part for part in parts if part is not None]
        return sum(known[1:], known[0]) * self.boundary.mean_transmittance**2 if len(known) == len(parts) else None

    def of_lasers(self, lasers: Sequence[int]) -> Self:
        """The model with these lasers, in this order; a laser may stand in it more than once."""
        return replace(self, terms=tuple(term.of_lasers(lasers) for term in self.terms))

    def save(self, path: Path) -> None:
        """Write an .npz, replacing any older one as a whole."""
        arrays = {"vertices": np.asarray(self.mesh.vertices, np.float64), "faces": np.asarray(self.mesh.faces)}
        for n, term in enumerate(self.terms):
            arrays |= {f"term{n}.{name}": array for name, array in term.arrays().items()}
        head = {"units": _units(self.terms), "boundary": asdict(self.boundary), "provenance": dict(self.provenance)}
        save_arrays(path, FORMAT_VERSION, arrays, terms=[term.kind for term in self.terms], **head)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote.

        Raises: InputError for other versions, unknown kinds of term and arrays that do not fit.
        """
        head, arrays = load_arrays(path, FORMAT_VERSION, REMEDY)
        try:
            kinds, b = head["terms"], head["boundary"]
            unknown = [kind for kind in kinds if kind not in KINDS]
            if unknown:
                raise InputError(
                    "unknown kind of term", file=path, key="terms", value=unknown[0],
                    allowed=", ".join(KINDS), remedy="read it with the version that wrote it, or reconstruct again",
                )  # fmt: skip
            parts = [{k[len(f"term{n}.") :]: a for k, a in arrays.items() if k.startswith(f"term{n}.")}
                     for n in range(len(kinds))]  # fmt: skip
            terms = tuple(KINDS[kind](**part) for kind, part in zip(kinds, parts, strict=True))
            if head["units"] != _units(terms):
                raise InputError("unknown units", file=path, key="units", value=head["units"], remedy=REMEDY)
            mesh = _surface(arrays["vertices"], arrays["faces"])
            boundary = _boundary(b["eta"], b["cosines"], b["ratio"])
            return cls(mesh, boundary, terms, head["provenance"])
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(f"is damaged, or no model ({in_words(error)})", file=path, remedy=REMEDY) from error


def _surface(vertices: NDArray[Any], faces: NDArray[Any]) -> trimesh.Trimesh:
    """Raises: ValueError for arrays that are no surface with an area."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind != "f" or not np.isfinite(vertices).all():
        raise ValueError("vertices are not (V, 3) finite numbers")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu" or not len(faces):
        raise ValueError("faces are not (F, 3) whole numbers")
    if not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError("faces and vertices do not fit")
    if np.abs(vertices).max() > FARTHEST_MM:
        raise ValueError(f"a vertex is more than {FARTHEST_MM:g} mm away")
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if not (RayMesh.of(mesh).vertex_areas > 0).all():
        raise ValueError("a vertex has no area around it")
    return mesh


def _boundary(eta: Any, cosines: Any, ratio: Any) -> Boundary:
    """Raises: ValueError, TypeError for what is no curve of a boundary."""
    at, values = np.array(cosines, np.float64), np.array(ratio, np.float64)
    if not 1 <= float(eta) <= 10:
        raise ValueError("boundary.eta is not 1 to 10")
    if at.ndim != 1 or at.shape != values.shape or not at.size:
        raise ValueError("boundary.cosines and boundary.ratio are not two equal lists")
    if not ((at >= 0) & (at <= 1)).all() or (np.diff(at) <= 0).any():
        raise ValueError("boundary.cosines do not rise from 0 to 1")
    if not ((values >= 0) & (values <= 1e3)).all():
        raise ValueError("boundary.ratio is not 0 to 1000")
    return Boundary(float(eta), tuple(map(float, at)), tuple(map(float, values)))


def _same(one: trimesh.Trimesh, other: trimesh.Trimesh) -> bool:
    return one is other or (np.array_equal(one.vertices, other.vertices) and np.array_equal(one.faces, other.faces))


def _units(terms: Sequence[Term]) -> dict[str, str]:
    """Unit by name of the array in the file."""
    named = {f"term{n}.{name}": term.axes()[name].unit for n, term in enumerate(terms) for name in term.arrays()}
    return {"vertices": "mm"} | named
