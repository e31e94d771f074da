"""Images of an object whose light below the surface is exact, with diffuse or exact ends: what no model can beat.

Eq. 2.1 of the thesis has two diffuse ends: light enters as if it came from all around, and leaves by F_t / pi whatever
the way it came. Here photons walk between ends that are exact, diffuse, or averaged over the scan's hat functions; the
differences to the references are the errors of each assumption alone. Every result is two independent halves, so that
scores hold no noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from disco_twin.experiment.experiment import Experiment
from disco_twin.object.mesh import hat_basis
from hw.base.arrays import F64, I64
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import Boundary, mean_transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.reconstruct.global_term.boundary_fit import SeenRadiosity, ratio_by_cosine
from pipeline.reconstruct.samples.spots import Spots
from pipeline.relight.irradiance import hat_moments
from pipeline.relight.lights import Light

if TYPE_CHECKING:
    from disco_twin.light.sources import Source

SAMPLE_WALKS, REPLICATES = 30_000, 4  # of a spot's exact samples; those whose spread is their noise
SPOTS_AT_ONCE = 5
PHOTONS_AT_ONCE = 1 << 18  # about a second: Ctrl-C is obeyed, and progress reported, between two calls of the renderer
NEGLIGIBLE = 1e-6  # of a pattern's power


@dataclass(frozen=True)
class _Pattern:
    """Light of one sign over the object. hat: (V_fine,) shape; lasers: (n,) that have it; watts: (n,) signed power."""

    hat: F64
    lasers: I64
    watts: F64


class ExactLight:
    """The object's light by photons. eta: the index that the ends assume; walks: photons of a light, both halves.

    walked: is told the number of photons that have been walked since it was told last
    """

    def __init__(self, experiment: Experiment, eta: float, walks: int) -> None:
        self.experiment, self.eta, self.walks = experiment, eta, walks
        self.walked: Callable[[int], None] = lambda photons: None
        self.mesh, self.scan = experiment.object.mesh, experiment.scan
        self.mean = mean_transmittance(eta)
        self.areas = RayMesh.of(self.mesh).vertex_areas
        self.basis = hat_basis(self.mesh, self.scan)

    def power_of(self, light: Light) -> F64:
        """(2, L, V_fine) W that leave at each vertex's hat function; the light enters as it does."""
        transport = self.experiment.transport  # starts the renderer, which the next module imports
        from disco_twin.light.sources import light_source

        _, power = self._trace(lambda group: light_source(light, transport.radius, group), 2, light.name)
        return power

    def _trace(
        self, source: Callable[[Sequence[int]], Source], tags: int, name: str, cameras: Sequence[PinholeCamera] = ()
    ) -> tuple[F64 | None, F64]:
        """(T, C, L, H, W) radiance from below the surface per W in the cameras, and (T, L, V_fine) power that leaves:
        means over `walks` photons of all T tags together, some at a time.
        """
        walks, images, power = max(1, self.walks // tags), None, np.zeros(())
        step = max(1, PHOTONS_AT_ONCE // tags)
        for first in range(0, walks, step):
            count = min(step, walks - first)
            traced = self.experiment.transport.trace(
                source, tags, count, seed=self.experiment.seed(f"budget {name}"), cameras=cameras, deposit=True,
                layers=2 if cameras else 1, first=first,
            )  # fmt: skip
            assert traced.deposits is not None
            power = power + traced.deposits * (count / walks)
            if traced.images is not None:
                below = traced.images[:, 0].astype(np.float64) * (count / walks)
                images = below if images is None else images + below
            self.walked(count * tags)
        return images, power

    def entering(self, light: Light) -> F64:
        """(L, V_fine) W/mm^2 whose transmitted share is the light's, if it came from all around: a diffuse entry."""
        lasers = self.experiment.transport.lasers
        return hat_moments(light, self.mesh, self.eta, lasers) / (self.areas * self.mean)

    def entering_on_hats(self, light: Light) -> F64:
        """As `entering`, as a model on the scan knows it: projected onto the scan's hat functions."""
        moments = hat_moments(light, self.scan, self.eta, self.experiment.transport.lasers)
        density = _solved(RayMesh.of(self.scan).mass_matrix, moments) / self.mean
        return np.asarray((self.basis @ density.T).T)

    def after_diffuse_entry(
        self, name: str, density: F64, cameras: Sequence[PinholeCamera] = ()
    ) -> tuple[F64 | None, F64]:
        """What leaves when light of (L, V_fine) W/mm^2 enters from all around; negative parts count as such.

        (2, C, L, H, W) radiance in W/(mm^2 sr) in the cameras, which are of one size, and (2, L, V_fine) W.
        """
        transport, lasers = self.experiment.transport, len(density)
        from disco_twin.light.sources import HatSource

        shape = (2, len(cameras), lasers, cameras[0].height, cameras[0].width) if cameras else None
        images, power = None if shape is None else np.zeros(shape), np.zeros((2, lasers, len(self.areas)))
        patterns = _patterns(density, self.areas)
        if not patterns:  # black light
            return images, power
        hats = np.stack([pattern.hat for pattern in patterns] * 2)  # the first half's, then the second's
        seen, left = self._trace(
            lambda group: HatSource(transport.vertices, transport.faces, hats, len(group)), len(hats), name, cameras
        )
        for tag in range(len(hats)):
            half, pattern = tag // len(patterns), patterns[tag % len(patterns)]
            power[half, pattern.lasers] += pattern.watts[:, None] * left[tag, pattern.lasers]
            if images is not None and seen is not None:
                images[half][:, pattern.lasers] += pattern.watts[:, None, None] * seen[tag][:, pattern.lasers]
        return images, power

    def spot_responses(self, spots: Spots) -> tuple[F64, F64]:
        """(L, S, V) R_d in mm^-2 from beams that enter from all around to the scan's hat functions, and its variance
        by the photons' noise; zeros for spots that are not used.
        """
        transport, fine = self.experiment.transport, self.mesh.subdivide()  # a footprint covers few triangles
        from disco_twin.light.importance import Splitting
        from disco_twin.light.sources import HatSource

        vertices, faces = np.asarray(fine.vertices, np.float64), np.asarray(fine.faces, np.int64)
        normals = np.asarray(fine.vertex_normals)
        area, lasers = np.asarray(self.basis.T @ self.areas), transport.lasers
        value, variance = np.zeros((2, lasers, len(spots.position), len(area)))
        used = np.flatnonzero(spots.transmitted > 0)
        for low in range(0, len(used), SPOTS_AT_ONCE):
            some = used[low : low + SPOTS_AT_ONCE]
            hats = np.repeat([_footprint(vertices, normals, spots, spot) for spot in some], REPLICATES, axis=0)

            def source(group: Sequence[int], hats: F64 = hats) -> HatSource:
                return HatSource(vertices, faces, hats, len(group))

            names = (some[:, None] * REPLICATES + np.arange(REPLICATES)).ravel().astype(np.uint32)
            traced = transport.trace(
                source, len(hats), SAMPLE_WALKS // REPLICATES, seed=self.experiment.seed("budget samples"),
                streams=names, deposit=True, split=Splitting(np.repeat(spots.position[some], REPLICATES, axis=0)),
            )  # fmt: skip
            assert traced.deposits is not None
            power = np.stack([(self.basis.T @ deposit.T).T for deposit in traced.deposits])
            r = power.reshape(len(some), REPLICATES, lasers, -1) / (area * self.mean**2)
            value[:, some] = np.moveaxis(r.mean(axis=1), 1, 0)
            variance[:, some] = np.moveaxis(r.var(axis=1, ddof=1), 1, 0) / REPLICATES
            self.walked(len(some) * SAMPLE_WALKS)
        return value, variance

    # ---- the diffuse exit: B = exitance / Tbar, seen by F_t / pi

    def radiosity(self, power: F64) -> F64:
        """(..., V_fine) W/mm^2 on the fine mesh from (..., V_fine) W."""
        return np.asarray(power / (self.areas * self.mean))

    def radiosity_on_hats(self, power: F64, consistent: bool) -> F64:
        """(..., V) W/mm^2 on the scan's vertices from (..., V_fine) W: mean over each hat, or projected onto them."""
        moments = np.asarray((self.basis.T @ power.reshape(-1, power.shape[-1]).T).T)
        if consistent:
            out = _solved(self._mass, moments)
        else:
            out = moments / (self.basis.T @ self.areas)
        return np.asarray(out.reshape(*power.shape[:-1], -1) / self.mean)

    @cached_property
    def _mass(self) -> sparse.csc_array:
        """(V, V) mm^2, products of the scan's hat functions integrated over the object, where light leaves."""
        return sparse.csc_array(self.basis.T @ RayMesh.of(self.mesh).mass_matrix @ self.basis)


def _patterns(density: F64, areas: F64) -> list[_Pattern]:
    """What to launch for (L, V_fine) W/mm^2: lasers whose light is shaped alike share their photons."""
    peak = np.abs(density).max(axis=1)
    share = density / np.maximum(peak, 1e-300)[:, None]
    every = np.arange(len(density))
    alike = np.allclose(share, share[:1], rtol=1e-3, atol=1e-6)
    out = []
    for lasers in [every] if alike else every[:, None]:
        shape = share[lasers[0]]
        for sign in (1.0, -1.0):
            hat = np.maximum(sign * shape, 0.0)
            if hat @ areas > NEGLIGIBLE * (np.abs(shape) @ areas):
                out.append(_Pattern(hat, lasers, sign * (hat @ areas) * peak[lasers]))
    return out


def _solved(mass: sparse.csc_array, moments: F64) -> F64:
    """(N, V) coefficients of hat functions from their (N, V) moments."""
    return np.asarray(sparse_linalg.spsolve(mass, moments.T).reshape(mass.shape[0], -1).T)


def _footprint(vertices: F64, normals: F64, spots: Spots, spot: int) -> F64:
    """(V,) 1 inside a beam where it meets the surface, 0 elsewhere: on the other side of a thin wall, too."""
    way = vertices - spots.position[spot]
    along = way @ spots.direction[spot]
    across2 = (way**2).sum(axis=1) - along**2
    near = np.abs(along) < 4 * spots.beam_radius  # not what lies behind
    met = normals @ spots.direction[spot] < 0.0  # nor where it would leave through a wall thinner than that
    inside = (across2 < spots.beam_radius**2) & near & met
    if not inside.any():  # between the vertices
        inside[np.argmin(np.where(met, (way**2).sum(axis=1), np.inf))] = True
    return np.asarray(inside, np.float64)


def best_curve(mesh: trimesh.Trimesh, eta: float, seen: Sequence[SeenRadiosity]) -> Boundary:
    """The one curve of the view cosine that explains all these references: an oracle, for floors alone.

    seen: with images in W/(mm^2 sr) and radiosities in W/mm^2. Each counts by its own peak. By its mean, a light that
    leaves most of a view dark would bend the curve where it says least, and the broad lights would lose by it
    (docs/decisions/0112).
    """
    scales = [1.0 / max(float(one.image.max()), 1e-300) for one in seen]
    weighed = (
        SeenRadiosity(one.camera, np.pi * scale * one.image, scale * one.radiosity)
        for one, scale in zip(seen, scales, strict=True)
    )
    middle, ratio = ratio_by_cosine(mesh, eta, weighed)
    return Boundary(eta, tuple(map(float, middle)), tuple(map(float, ratio))) if len(middle) else Boundary(eta)
