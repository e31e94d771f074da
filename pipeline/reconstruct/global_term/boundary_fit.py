"""The boundary's transmittance at all angles, measured against that of the assumed index (F_t of thesis eq. 2.1).

Samples come from views that are not too oblique. The same images show the surface at grazing angles too, where a rough
one transmits several times what the smooth one of the assumed index does: most of a relit image's error near the
outline. The images of all spots are summed and compared, by view cosine, with what the model expects. There normals
that are off by a few degrees, and light that the model's hats smear around an edge, change the light as much as
roughness does; so the curve is that of a GGX surface, whose roughness is fitted with a weight that knows the normals'
errors, times a line in the cosine for the index and for light that is not equal in all directions inside
(docs/decisions/0124). By reciprocity it holds for light that enters, too. R_d and the transmittance share one level,
which images do not part: R_d has it, and the ratio is 1 on average where samples were taken (docs/decisions/0093).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import trimesh

from hw.base.arrays import F64
from pipeline.calibrate.least_squares import Huber, Prior, likeliest, minimise
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import Boundary, transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.microfacet import rough_transmittance
from pipeline.geometry.pixel_footprints import trace_pixels
from pipeline.reconstruct.samples.samples import Samples, SpotSumImage

log = logging.getLogger(__name__)

EDGES = np.array([0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0 + 1e-9])
SUPERSAMPLE = 3
MATCHED = 1e-3  # difference of the indices below which all light passes
ALPHAS = np.geomspace(0.02, 0.64, 16)
USUAL, USUAL_SPREAD = np.log(0.2), 1.2  # of log alpha, before the images say anything
LINE_SPREAD = 0.1  # of the line's slope: what an index of 1.3 to 1.7, and light inside that is not diffuse, make it
NORMAL_ERROR = 0.03  # rad, that the scan's normals have in common at one view cosine
BIN_ERROR = 0.02  # relative, of a bin: what the model leaves of the sums
OUTLIER = Huber(2.0)
CURVE = np.concatenate([[0.0], np.geomspace(0.002, 0.05, 8), np.linspace(0.1, 1.0, 19)])  # cosines of its corners


@dataclass(frozen=True)
class SeenRadiosity:
    """An image and the radiosity that should explain it: image = F_t * radiosity, without a factor between their units.

    camera; image: (L, H, W); radiosity: (L, V) on a mesh's vertices
    """

    camera: PinholeCamera
    image: F64
    radiosity: F64


def ratio_by_cosine(mesh: trimesh.Trimesh, eta: float, seen: Iterable[SeenRadiosity]) -> tuple[F64, F64]:
    """(n,) view cosines, and there (n,) the light of all these images over what the smooth F_t lets out of the
    radiosity that should explain them; wavelengths together. Cosines that next to no light is expected at are left out.
    """
    bins = len(EDGES) - 1
    observed, expected = np.zeros(bins), np.zeros(bins)
    for one in seen:
        flat = one.image.sum(axis=0).ravel()
        for band in trace_pixels(mesh, one.camera, SUPERSAMPLE):
            whole = np.bincount(band.pixel, minlength=flat.size)[band.pixel] == SUPERSAMPLE**2
            use = np.flatnonzero(whole & (band.cosine > 0))
            cosine = band.cosine[use]
            at = np.minimum(np.searchsorted(EDGES, cosine, side="right") - 1, bins - 1)
            here = RayMesh.of(mesh).interpolation(band.triangle[use], band.barycentric[use])
            model = (here @ one.radiosity.T).sum(axis=1)
            observed += np.bincount(at, flat[band.pixel[use]], bins)
            expected += np.bincount(at, transmittance(cosine, eta) * model, bins)
    known = np.flatnonzero(expected > 1e-3 * expected.max(initial=0.0))
    return 0.5 * (EDGES[known] + EDGES[known + 1]), observed[known] / expected[known]


def measure_boundary(
    mesh: trimesh.Trimesh, eta: float, views: tuple[SpotSumImage, ...], expected: Callable[[SpotSumImage], F64]
) -> Boundary:
    """The boundary with its measured ratio.

    expected: view -> (L, S, V) mm^-2, the model's R_d between spots and vertices as seen from there, with all that
    directions do beside the boundary: the ratio holds whatever is left.
    """
    middle, ratio = ratio_by_cosine(
        mesh,
        eta,
        (
            SeenRadiosity(
                view.camera,
                view.image,
                np.einsum("ls,lsv->lv", view.included.astype(np.float64), expected(view)),
            )
            for view in views
        ),
    )
    return rough_boundary(eta, middle, ratio)


def rough_boundary(eta: float, cosines: F64, ratio: F64) -> Boundary:
    """The boundary whose transmittance over the smooth one is (K,) `ratio` at (K,) cosines, within their errors.

    Smooth where too few bins are known.
    """
    known = (ratio > 0) & (cosines > 0) & np.isfinite(ratio)
    if known.sum() < 3 or eta - 1 < MATCHED:
        return Boundary(eta)
    c, measured = cosines[known], np.log(ratio[known])
    slope = np.gradient(np.log(transmittance(np.stack([c - 0.01, c, c + 0.01]), eta)), 0.01, axis=0)[1]
    sigma = np.hypot(BIN_ERROR, NORMAL_ERROR * np.sqrt(1.0 - c**2) * slope)
    line = np.column_stack([np.ones(len(c)), 1.0 - c])
    prior = Prior(np.zeros(2), np.diag([1e-6, LINE_SPREAD**-2]))

    def fitted(log_alpha: float) -> tuple[F64, float]:
        rough = np.log(rough_transmittance(c, eta, float(np.exp(log_alpha))) / transmittance(c, eta))
        found = minimise(lambda x: (line @ x + rough - measured) / sigma, np.zeros(2), prior, loss=OUTLIER)
        if not found.ended.converged:  # such an alpha is not the likeliest
            return found.value, np.inf
        cost = OUTLIER.cost(found.residual).sum() + (found.value[1] / LINE_SPREAD) ** 2
        return found.value, float(cost + ((log_alpha - USUAL) / USUAL_SPREAD) ** 2)

    tried = np.array([fitted(log_alpha)[1] for log_alpha in np.log(ALPHAS)])
    if not (finite := np.isfinite(tried)).any():
        log.warning("no roughness explains what the images show of the boundary: taken as smooth")
        return Boundary(eta)
    lowest = int(np.argmin(tried))
    best = float(np.log(ALPHAS[lowest]))
    if finite[max(lowest - 1, 0) : lowest + 2].all():  # else there is no parabola through its neighbours
        best, _ = likeliest(np.log(ALPHAS), np.where(finite, tried, tried[finite].max()))
    at, (level, tilt) = np.maximum(CURVE, 1e-3), fitted(best)[0]
    curve = rough_transmittance(at, eta, float(np.exp(best))) / transmittance(at, eta) * np.exp(level + tilt * (1 - at))
    return Boundary(eta, tuple(map(float, CURVE)), tuple(map(float, curve)))


def of_mean_one(boundary: Boundary, samples: Samples, expected: F64) -> Boundary:
    """The boundary with its ratio divided by the mean that it has where light of the samples enters and leaves.

    A sample is divided by the smooth F_t of both ends, so R_d holds the product of the ratio's means there. A ratio
    that holds a mean, too, would count it at either end once more. One curve serves both ends: it is divided by the
    geometric mean of theirs.

    expected: (L, S, V) mm^-2, the model's R_d between spots and vertices
    """
    spots, area = samples.spots, RayMesh.of(samples.mesh).vertex_areas
    light = np.where(np.isfinite(samples.values), expected, 0.0).sum(axis=0) * area  # (S, V)
    entry = np.interp(-(spots.normal * spots.direction).sum(axis=1), boundary.cosines, boundary.ratio)
    leaving = np.interp(samples.cosine, boundary.cosines, boundary.ratio)
    total = light.sum()
    if not total > 0:
        return boundary
    level = np.sqrt((light.sum(axis=1) @ entry) * (light * leaving).sum()) / total
    return Boundary(boundary.eta, boundary.cosines, tuple(float(r / level) for r in boundary.ratio))
