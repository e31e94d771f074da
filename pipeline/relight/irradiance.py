"""Light -> transmitted flux per vertex: q_u, the input of the reflectance model.

T(x) = integral L(x, w) F_t(w) cos dw is what passes the boundary at x (W/mm^2); the moment of a vertex is
integral hat_u(x) T(x) dA. Flat faces and their true normals are used throughout, so that power is conserved exactly;
shadows come from rays. Lights of one direction per point have sharp edges (of the light, of its texture, of shadows):
cells that an edge crosses are split until what is left is below a tolerance. Lights from many directions are smooth
on the surface and sharp in direction: a fixed grid of points, many directions each.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import linalg as sparse_linalg

from hw.base.arrays import F64, I64
from pipeline.geometry.fresnel import Boundary, along_surface, transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.relight.incident_light import colour, finest_mm, from_many_directions, from_one_direction
from pipeline.relight.lights import Environment, Light, Uniform

if TYPE_CHECKING:
    import trimesh

_RULE = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4]]) / 6  # three points, exact to the second degree
_HALVES = 0.5 * np.array(
    [
        [[2, 0, 0], [1, 1, 0], [1, 0, 1]],
        [[1, 1, 0], [0, 2, 0], [0, 1, 1]],
        [[1, 0, 1], [0, 1, 1], [0, 0, 2]],
        [[0, 1, 1], [1, 0, 1], [1, 1, 0]],
    ]
)  # corners of the four halves-size children in the parent's barycentric coordinates
_CHUNK = 1 << 20  # rays at once


@dataclass(frozen=True)
class Accuracy:
    """How finely to integrate. The defaults keep the error well below that of a 642-vertex mesh's shape.

    tolerance:  estimated error of the vertex moments left by the last split, as a share of the total flux
    splits:     largest number of splits of a cell
    directions: per point, for lights from many directions
    """

    tolerance: float = 1e-4
    splits: int = 10
    directions: int = 256


def received(
    surface: RayMesh, light: Light, face: I64, points: F64, eta: float | Boundary, lasers: int, directions: int = 256
) -> F64:
    """(L, N) transmitted flux density T in W/mm^2 at (N, 3) points on (N,) faces. eta = 1: the plain irradiance."""
    return np.asarray(_received(surface, light, face, points, eta, lasers, directions, tilted=False)[0])


def _received(
    surface: RayMesh, light: Light, face: I64, points: F64, eta: float | Boundary, lasers: int, count: int, tilted: bool
) -> F64:
    """(1, L, N) T, or (4, L, N) with the components of T's first moment, integral L(x, w) F_t(w) cos t(w) dw."""
    if isinstance(light, Uniform | Environment):
        return _received_from_many(surface, light, face, points, eta, lasers, count, tilted)
    towards, across = from_one_direction(light, points)
    normal = surface.normals[face]
    cosine = (towards * normal).sum(axis=1)
    density = np.where(cosine > 0, across * transmittance(cosine, eta) * cosine, 0.0)
    lit = np.flatnonzero(density > 0)
    density[lit[surface.blocked(face[lit], points[lit], towards[lit])]] = 0.0
    part = density[None]
    if tilted:
        part = np.concatenate([part, density * along_surface(-towards, normal, _index(eta)).T])
    return np.asarray(colour(light, lasers)[:, None] * part[:, None])


def _index(eta: float | Boundary) -> float:
    return eta.eta if isinstance(eta, Boundary) else eta


def _received_from_many(
    surface: RayMesh,
    light: Uniform | Environment,
    face: I64,
    points: F64,
    eta: float | Boundary,
    lasers: int,
    count: int,
    tilted: bool,
) -> F64:
    total = np.zeros((4 if tilted else 1, lasers, len(face)))
    step = max(1, _CHUNK // count)
    for start in range(0, len(face), step):
        part = slice(start, start + step)
        f, p = face[part], points[part]
        normals = surface.normals[f]
        for towards, weight in from_many_directions(light, normals, count, lasers):
            cosine = np.einsum("nkx,nx->nk", towards, normals)
            ft = transmittance(cosine, eta)
            ask = np.nonzero((ft > 0) & ~surface.free[f][:, None])
            hidden = surface.blocked(f[ask[0]], p[ask[0]], towards[ask])
            ft[ask[0][hidden], ask[1][hidden]] = 0.0
            total[0, :, part] += np.einsum("lnk,nk->ln", weight, ft)
            if tilted:
                along = along_surface(-towards, normals[:, None], _index(eta))
                total[1:, :, part] += np.einsum("lnk,nkx->xln", weight, ft[:, :, None] * along)
    return total


def _first_cells(surface: RayMesh, light: Light) -> tuple[I64, F64]:
    """Cells (C,) faces and (C, 3, 3) corners in barycentric coordinates, fine enough that no structure is missed."""
    longest = surface.size / (12 if isinstance(light, Uniform | Environment) else 40)
    face, bary = np.arange(len(surface.faces)), np.broadcast_to(np.eye(3), (len(surface.faces), 3, 3))
    faces, corners = [], []
    while len(face):
        points = np.einsum("cib,cbx->cix", bary, surface.corners[face])
        length = np.linalg.norm(points - np.roll(points, 1, axis=1), axis=2).max(axis=1)
        coarse = length > np.minimum(longest, finest_mm(light, points.mean(axis=1), length) / 4)
        faces.append(face[~coarse])
        corners.append(bary[~coarse])
        face, bary = _split(face[coarse], bary[coarse])
    return np.concatenate(faces), np.concatenate(corners)


def _split(face: I64, bary: F64) -> tuple[I64, F64]:
    """Cells -> four children each, the children of a cell next to each other."""
    return np.repeat(face, 4), np.einsum("kij,cjb->ckib", _HALVES, bary).reshape(-1, 3, 3)


def _moments(
    surface: RayMesh,
    light: Light,
    face: I64,
    bary: F64,
    eta: float | Boundary,
    lasers: int,
    directions: int,
    tilted: bool,
) -> F64:
    """(1 or 4, L, C, 3) W: integrals of what `_received` returns times the face's hat functions over each cell."""
    at = np.einsum("pj,cjb->cpb", _RULE, bary)  # (C, 3 points, 3)
    flat = at.reshape(-1, 3)
    owner = np.repeat(face, 3)
    density = _received(surface, light, owner, surface.points(owner, flat), eta, lasers, directions, tilted)
    area = surface.areas[face] * np.abs(np.linalg.det(bary)) / 3
    return np.asarray(np.einsum("mlcp,cpb,c->mlcb", density.reshape(*density.shape[:2], -1, 3), at, area))


def hat_moments(
    light: Light, mesh: trimesh.Trimesh, eta: float | Boundary, lasers: int, accuracy: Accuracy | None = None
) -> F64:
    """(L, V) integrals of hat_u T dA in W; they add up to all the flux that passes the boundary."""
    return np.asarray(_integrated(light, mesh, eta, lasers, accuracy or Accuracy(), tilted=False)[0])


def tilted_moments(
    light: Light, mesh: trimesh.Trimesh, boundary: Boundary, lasers: int, accuracy: Accuracy | None = None
) -> F64:
    """(4, L, V) W: `hat_moments`, and the same of T times the mean of t, the refracted direction along the surface
    (`pipeline.model.tilt`), by component. Cells are split where T itself asks for it.
    """
    return _integrated(light, mesh, boundary, lasers, accuracy or Accuracy(), tilted=True)


def _integrated(
    light: Light, mesh: trimesh.Trimesh, eta: float | Boundary, lasers: int, accuracy: Accuracy, tilted: bool
) -> F64:
    surface = RayMesh.of(mesh)
    face, bary = _first_cells(surface, light)
    total = np.zeros((4 if tilted else 1, lasers, surface.vertices))

    def add(owner: I64, part: F64) -> None:
        for m, laser in np.ndindex(total.shape[:2]):
            total[m, laser] += np.bincount(surface.faces[owner].ravel(), part[m, laser].ravel(), surface.vertices)

    coarse = _moments(surface, light, face, bary, eta, lasers, accuracy.directions, tilted)
    for _ in range(0 if isinstance(light, Uniform | Environment) else accuracy.splits):
        kids, kid_bary = _split(face, bary)
        fine = _moments(surface, light, kids, kid_bary, eta, lasers, accuracy.directions, tilted)
        better = fine.reshape(len(fine), lasers, len(face), 4, 3).sum(axis=3)
        error = np.abs(better[0] - coarse[0]).sum(axis=2).max(axis=0)
        allowed = accuracy.tolerance * float((total[0].sum(axis=1) + better[0].sum(axis=(1, 2))).max())
        order = np.argsort(error)
        again = np.zeros(len(face), bool)
        again[order[np.cumsum(error[order]) > allowed]] = True
        add(face[~again], better[:, :, ~again])
        chosen = np.repeat(again, 4)
        face, bary, coarse = kids[chosen], kid_bary[chosen], fine[:, :, chosen]
        if not len(face):
            break
    add(face, coarse)
    return total


def flux_of(moments: F64, mesh: trimesh.Trimesh) -> F64:
    """(L, V) flux q in W for radiosity = sum_u R_d[u, :] q_u, with R_d averaged over hat functions.

    q = A M^-1 (moments), with the mass matrix M and the vertex areas A: the flux density is projected onto the hat
    functions and multiplied by their areas. The sum over the vertices is the total transmitted flux. See
    docs/decisions/0005-flux-projection.md for why.
    """
    surface = RayMesh.of(mesh)
    density = sparse_linalg.spsolve(surface.mass_matrix, moments.T).reshape(surface.vertices, len(moments))
    return np.asarray((density * surface.vertex_areas[:, None]).T)
