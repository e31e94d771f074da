"""Light that diffuses inside the scan, and crosses the air between parts that face each other.

The diffusion equation -div(D grad phi) + sigma_a phi = 0 with what enters as a flux through the surface, and a boundary
of Robin's kind for a refractive index (Haskell et al. 1994, eq. 2.4.4), in linear finite elements on tetrahedra. What
leaves a folded object meets it again: of the light that crosses from one hat function to another (radiosity, Goral et
al. 1984) a share enters there. On an animal of 40 mm it is most of what goes from leg to leg (docs/decisions/0125).
"""

from __future__ import annotations

from dataclasses import dataclass

import gpytoolbox
import numpy as np
import trimesh
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from hw.base.arrays import F64
from pipeline.geometry.fresnel import mean_transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.reconstruct.medium.tetrahedra import NoMedium, fill

ROUNDS, MOST_OFF = 20, 0.05  # of remeshing; share of the volume that it may lose
MOST_VERTICES = 2000  # of a scan that is filled as it is; time grows with the cube, and fluence is smooth


@dataclass(frozen=True)
class Diffusion:
    """The inside of a scan of V vertices in finite elements of N nodes, the first M of them on its surface.

    stiffness: (N, N) integrals of grad . grad in mm; mass: (N,) of the linear functions in mm^3; surface: (M, M) what
    leaves, less what enters again, per fluence rate, in mm^2; open_area: (M,) mm^2 of the surface's hat functions,
    times the share of what leaves there that leaves for good; hats: (V, M) values at the surface's nodes
    -> values at the scan's vertices; edge: mean length of the surface's edges, mm
    """

    stiffness: F64
    mass: F64
    surface: F64
    open_area: F64
    hats: sparse.csr_array
    edge: float

    @classmethod
    def of(cls, scan: trimesh.Trimesh, eta: float) -> Diffusion:
        """Of a closed scan with a smooth boundary of index `eta`. Raises: NoMedium where it cannot be filled."""
        mesh, hats = _coarse(scan)
        tets, surface = fill(mesh), RayMesh.of(mesh)
        count, rows = len(tets.points), np.repeat(np.arange(len(tets.corners)), 4)
        stiffness = np.zeros((count, count))
        for along in np.moveaxis(tets.gradients, 1, 0):
            gradient = sparse.csr_array((along.ravel(), (rows, tets.corners.ravel())), shape=(len(tets.corners), count))
            stiffness += (gradient.T @ (gradient * tets.volumes[:, None])).toarray()
        mass = np.bincount(tets.corners.ravel(), np.repeat(tets.volumes / 4, 4), minlength=count).astype(np.float64)
        inward = mean_transmittance(eta)  # of diffuse light from outside
        outward = inward / eta**2  # of diffuse light from inside (reciprocity)
        leaving = outward / (2 * (2 - outward))  # flux out per fluence rate
        net = np.diag(surface.vertex_areas) - inward * surface.exchange.toarray()
        edge = float(mesh.edges_unique_length.mean())
        return cls(stiffness, mass, leaving * net, surface.open_areas(inward), hats, edge)

    def solver(self, diffusivity: float, absorption: float) -> Solver:
        """For D in mm and sigma_a in 1/mm. Raises: LinAlgError where the system is not positive definite."""
        matrix = diffusivity * self.stiffness
        matrix[np.diag_indices_from(matrix)] += absorption * self.mass
        on_surface = len(self.surface)
        matrix[:on_surface, :on_surface] += self.surface
        return Solver(cho_factor(matrix, lower=True, overwrite_a=True))

    def between(self, diffusivity: float, absorption: float) -> F64:
        """(M, M) fluence rate at one node of the surface per flux into another in 1/mm^2; symmetric. Where it is not
        positive, elements were too coarse for what it fell by.
        """
        on_surface = len(self.surface)
        fluence = self.solver(diffusivity, absorption)(np.eye(on_surface))[:on_surface]
        return np.asarray(0.5 * (fluence + fluence.T))


@dataclass(frozen=True)
class Solver:
    """A factored system (Cholesky)."""

    factor: tuple[F64, bool]

    def __call__(self, sources: F64) -> F64:
        """(N, K) fluence rates of (N, K) fluxes that enter at the nodes, or of (M, K) at the first M."""
        size = len(self.factor[0])
        if len(sources) < size:
            sources = np.concatenate([sources, np.zeros((size - len(sources), sources.shape[1]))])
        return np.asarray(cho_solve(self.factor, sources))


def _coarse(scan: trimesh.Trimesh) -> tuple[trimesh.Trimesh, sparse.csr_array]:
    """A closed mesh of some MOST_VERTICES vertices at most, and what carries values on it to the scan's vertices."""
    count = len(scan.vertices)
    if count <= MOST_VERTICES:
        return scan, sparse.eye_array(count, format="csr")
    vertices, faces = np.asarray(scan.vertices, np.float64), np.asarray(scan.faces, np.int32)
    edge = float(np.sqrt(2.0 * scan.area / (np.sqrt(3.0) * MOST_VERTICES)))  # of as many equilateral triangles
    own = gpytoolbox.remesh_botsch(vertices, faces, ROUNDS, edge, True)
    mesh = trimesh.Trimesh(*own, process=False)
    if not (len(mesh.faces) and mesh.is_watertight and abs(mesh.volume / scan.volume - 1) < MOST_OFF):
        raise NoMedium(f"the scan loses its shape with {MOST_VERTICES} vertices, as which it would be filled")
    _, triangle, hat = gpytoolbox.squared_distance(vertices, *own, use_cpp=True)
    return mesh, RayMesh.of(mesh).interpolation(np.asarray(triangle, np.int64), np.asarray(hat, np.float64))
