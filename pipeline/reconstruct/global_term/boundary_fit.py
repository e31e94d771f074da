"""The boundary's transmittance at grazing angles, measured against that of the assumed index (F_t of thesis eq. 2.1).

Samples come from views that are not too oblique. The same images show the surface at grazing angles too, where a rough
one transmits up to twice what the smooth one of the assumed index does: most of a relit image's error near the outline.
The images of all spots are summed and compared, by view cosine, with what the model expects. By reciprocity the ratio
holds for light that enters, too.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh

from hw.base.arrays import F64
from pipeline.geometry.fresnel import Boundary, transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.pixel_footprints import trace_pixels
from pipeline.reconstruct.samples.samples import SpotSumImage

EDGES = np.array([0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0 + 1e-9])
LEAST, MOST = 0.5, 2.0  # of the smooth transmittance; at the outline itself scan and object do not meet
SUPERSAMPLE = 3


def _accumulate(mesh: trimesh.Trimesh, view: SpotSumImage, radiosity: F64, eta: float) -> tuple[F64, F64]:
    """Sums over the samples of one view by bin of view cosine: observed, and expected with the smooth F_t.

    radiosity: (L, V) expected sum over the view's spots at the vertices, mm^-2
    """
    camera, bins = view.camera, len(EDGES) - 1
    observed, expected = np.zeros(bins), np.zeros(bins)
    image = view.image.reshape(len(view.image), -1)
    for band in trace_pixels(mesh, camera, SUPERSAMPLE):
        whole = np.bincount(band.pixel, minlength=image.shape[1])[band.pixel] == SUPERSAMPLE**2
        use = np.flatnonzero(whole & (band.cosine > 0))
        cosine = band.cosine[use]
        at = np.minimum(np.searchsorted(EDGES, cosine, side="right") - 1, bins - 1)
        model = (RayMesh.of(mesh).interpolation(band.triangle[use], band.barycentric[use]) @ radiosity.T).sum(axis=1)
        observed += np.bincount(at, image[:, band.pixel[use]].sum(axis=0), bins)
        expected += np.bincount(at, transmittance(cosine, eta) * model, bins)
    return observed, expected


def measure_boundary(
    mesh: trimesh.Trimesh, eta: float, views: tuple[SpotSumImage, ...], expected: Callable[[SpotSumImage], F64]
) -> Boundary:
    """The boundary with its measured ratio.

    expected: view -> (L, S, V) mm^-2, the model's R_d between spots and vertices as seen from there, with all that
    directions do beside the boundary: the ratio holds whatever is left.
    """
    seen, model = np.zeros(len(EDGES) - 1), np.zeros(len(EDGES) - 1)
    for view in views:
        radiosity = np.einsum("ls,lsv->lv", view.included.astype(np.float64), expected(view))
        s, m = _accumulate(mesh, view, radiosity, eta)
        seen += s
        model += m
    known = np.flatnonzero(model > 1e-3 * model.max(initial=0.0))
    if not len(known):
        return Boundary(eta)
    ratio = np.clip(seen[known] / model[known], LEAST, MOST)
    middle = 0.5 * (EDGES[known] + EDGES[known + 1])
    return Boundary(eta, tuple(map(float, middle)), tuple(map(float, ratio)))
