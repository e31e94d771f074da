"""Error against time of what stands between samples and a model, on a ball whose R_d is known in closed form.

completion   all entries of R_d by decade below the peak, against the number of spots and of vertices: log10 of model
             over truth, root mean square; peak memory counts in the whole benchmark's
lobe         the reflection that is found in samples that one was added to, against the number of spots: relative error
             of what is taken off
boundary     the transmittance of a rough surface, against the number of facets: largest absolute error
medium       light that diffuses from point to point of the ball, against the number of its vertices: log10 of elements
             over spherical harmonics more than 8 mm away, root mean square
exchange     light between two facing squares, against the number of directions: relative error of their form factor

The ball has R_d(x, y) = a(x) a(y) f(|x - y|) with a narrow and a wide exponential and a smooth a; samples carry 3 %
noise and a third of the surface is hidden from each third of the spots. Two cameras look at every spot.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import trimesh
from numpy.polynomial.legendre import legval
from scipy.special import spherical_in

from hw.base.arrays import F64
from pipeline.geometry import mesh as geometry
from pipeline.geometry import microfacet
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import mean_transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.microfacet import rough_transmittance
from pipeline.model.reflectance import GlobalTerm
from pipeline.reconstruct.global_term.completion import complete
from pipeline.reconstruct.medium.diffusion import Diffusion
from pipeline.reconstruct.samples.distances import vertex_pairs
from pipeline.reconstruct.samples.samples import Samples, SpotSumImage
from pipeline.reconstruct.samples.spots import Spots
from pipeline.reconstruct.samples.surface_lobe import BeamReadings
from pipeline.reconstruct.surface_term.lobe_fit import subtract_reflection

RADIUS, BEAM, ETA, NOISE, HIDDEN, CONTRAST = 10.0, 0.5, 1.3, 0.03, 0.33, 0.2
ALPHA, STRENGTH = 0.3, 2.5  # of the lobe that is added
DECADES = 3
DIFFUSIVITY, ABSORPTION, FAR_MM = 0.4, 0.004, 8.0  # mm, 1/mm, mm
FACING = 0.19982  # form factor of squares as far apart as they are wide (Howell's catalogue, C-11)


def kernel(distance: F64) -> F64:
    """f in mm^-2."""
    return np.asarray(0.03 * np.exp(-distance / 0.8) + 0.004 * np.exp(-distance / 4.0))


def ball(subdivisions: int, spots: int, seed: int) -> tuple[Samples, F64]:
    """Samples, and (V, V) the truth in mm^-2."""
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
    surface, points = RayMesh.of(mesh), np.asarray(mesh.vertices, np.float64)
    log_a = CONTRAST * np.sin(points[:, 0] / 4.0 + 1.0) * np.cos(points[:, 2] / 5.0)
    triangle, barycentric = rng.integers(len(mesh.faces), size=spots), rng.dirichlet(np.ones(3), spots)
    position, normal = surface.points(triangle, barycentric), surface.smooth_normals(triangle, barycentric)
    where = Spots(position, -normal, normal, triangle, barycentric, np.full(spots, 0.98), BEAM)
    shape = (1, spots, len(points))
    empty, flat = np.full(shape, np.nan, np.float32), np.zeros(shape[1:])
    bare = Samples(mesh, ETA, where, empty, empty, empty, flat.astype(np.float32), flat, np.ones(shape[1:], np.float32))
    at_spots = surface.interpolation(triangle, barycentric) @ log_a
    exact = bare.spot_pairs.mean(kernel) * np.exp(at_spots[:, None] + log_a)
    value = exact * (1 + NOISE * rng.standard_normal(exact.shape))
    for group, towards in enumerate(rng.standard_normal((3, 3))):
        depth = points @ towards
        value[group::3, depth < np.quantile(depth, HIDDEN)] = np.nan
    samples = bare.with_readings(
        values=value[None].astype(np.float32),
        dark_variance=np.zeros(shape, np.float32),
        noise_per_signal=(NOISE**2 * np.nan_to_num(value[None])).astype(np.float32),
        **_looked_at(mesh, where, bare),
    )
    truth = vertex_pairs(mesh).mean(kernel) * np.exp(log_a[:, None] + log_a)
    return samples, np.asarray(0.5 * (truth + truth.T))


def _looked_at(mesh: trimesh.Trimesh, spots: Spots, bare: Samples) -> dict[str, Any]:
    views, lit, pairs = [], bare.lit.tocoo(), []
    for view, towards in enumerate(np.array([[0.8, 0.5, 0.3], [-0.8, -0.4, 0.4]])):
        direction = towards / np.linalg.norm(towards)
        pose = np.asarray(trimesh.geometry.align_vectors(-direction, [0, 0, 1]))
        pose[2, 3] = 400.0
        camera = PinholeCamera(64, 64, np.array([900.0, 900.0]), np.array([32.0, 32.0]), np.zeros(5), pose)
        facing = spots.normal @ direction > 0.3
        views.append(SpotSumImage(camera, np.zeros((1, 64, 64)), facing[None].copy()))
        own = facing[lit.row]
        pairs.append(np.column_stack([lit.row[own], lit.col[own], np.full(own.sum(), view)]).astype(np.int64))
    spot, vertex, of_view = np.concatenate(pairs).T
    times = np.zeros((len(spots.position), len(mesh.vertices)))
    np.add.at(times, (spot, vertex), 1.0)
    read = BeamReadings(spot, vertex, of_view, 1.0 / times[spot, vertex])
    return {"glow": tuple(views), "read_in_beams": read}


def completion(subdivisions: int, spots: int) -> dict[str, Any]:
    """One point of the curve."""
    samples, truth = ball(subdivisions, spots, seed=spots)
    start = time.perf_counter()
    term = complete(samples).terms[0]
    seconds = time.perf_counter() - start
    assert isinstance(term, GlobalTerm)
    decade = np.ceil(np.log10(truth / truth.max())).astype(int)
    error = np.log10(term.reflectance[0] / truth)
    by_decade = [float(np.sqrt((error[decade == -k] ** 2).mean())) for k in range(DECADES)]
    settings = {"spots": spots, "vertices": len(truth)} | {f"decade -{k}": e for k, e in enumerate(by_decade)}
    return {"seconds": seconds, "error": float(np.sqrt((error**2).mean())), "settings": settings}


def lobe(subdivisions: int, spots: int) -> dict[str, Any]:
    """Of what is taken off, all spots together."""
    samples, _ = ball(subdivisions, spots, seed=1)
    at, value = samples.read_in_beams, samples.values.astype(np.float64)
    added = STRENGTH * samples.beams.in_samples(ALPHA)
    np.add.at(value[0], (at.spot, at.vertex), added)
    bright = samples.with_readings(values=value.astype(np.float32))
    start = time.perf_counter()
    clean = subtract_reflection(bright)
    seconds = time.perf_counter() - start
    left = np.nansum(clean.values.astype(np.float64) - samples.values)
    seen = np.isfinite(samples.values[0, at.spot, at.vertex])
    return {"seconds": seconds, "error": float(abs(left) / added[seen].sum()), "settings": {"spots": spots}}


def boundary(facets: int, fine: F64) -> dict[str, Any]:
    """At cosines from grazing to upright; fine: the same by far more facets."""
    kept = microfacet.FACETS
    try:
        microfacet.FACETS = facets
        start = time.perf_counter()
        value = rough_transmittance(np.linspace(0.05, 1.0, 20), 1.5, 0.3)
        seconds = time.perf_counter() - start
    finally:
        microfacet.FACETS = kept
    error = float(np.abs(value - fine).max()) if len(fine) else 0.0
    return {"seconds": seconds, "error": error, "settings": {"facets": facets}, "value": value}


def medium(subdivisions: int) -> dict[str, Any]:
    """Fluence rates between all vertices."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
    start = time.perf_counter()
    elements = Diffusion.of(mesh, ETA)
    light = elements.hats @ (elements.hats @ elements.between(DIFFUSIVITY, ABSORPTION)).T
    seconds = time.perf_counter() - start
    unit = np.asarray(mesh.vertices) / RADIUS
    cosine = np.clip(unit @ unit.T, -1.0, 1.0)
    far = RADIUS * np.sqrt(2.0 - 2.0 * cosine) > FAR_MM
    t = mean_transmittance(ETA) / ETA**2
    error = np.log10(light[far] / series(cosine[far], t / (2.0 * (2.0 - t))))
    return {"seconds": seconds, "error": float(np.sqrt((error**2).mean())), "settings": {"vertices": len(unit)}}


def series(cosine: F64, leaving: float) -> F64:
    """Fluence rate on the ball per flux into a point of it, by orders of spherical harmonics; the point spreads over a
    twentieth of the radius.
    """
    order, kappa = np.arange(200), np.sqrt(ABSORPTION / DIFFUSIVITY)
    inside, slope = (spherical_in(order, kappa * RADIUS, derivative=d) for d in (False, True))
    with np.errstate(invalid="ignore", divide="ignore"):
        own = kappa * slope / inside
    own = np.where(np.isfinite(own) & (inside > 0), own, order / RADIUS)  # where both underflow
    spread = np.exp(-order * (order + 1) * 0.05**2 / 2)
    weight = (2 * order + 1) / (4 * np.pi * RADIUS**2) * spread / (DIFFUSIVITY * own + leaving)
    return np.asarray(legval(cosine, weight))


def exchange(directions: int) -> dict[str, Any]:
    """Two slabs of 10 mm, 10 mm apart."""
    slabs = []
    for z in (-6.0, 6.0):
        slab = trimesh.creation.box((10.0, 10.0, 2.0)).subdivide().subdivide()
        slab.apply_translation((0.0, 0.0, z))
        slabs.append(slab)
    kept = geometry.EXCHANGE_DIRECTIONS
    try:
        geometry.EXCHANGE_DIRECTIONS = directions
        start = time.perf_counter()
        total = float(RayMesh.of(trimesh.util.concatenate(slabs)).exchange.sum())
        seconds = time.perf_counter() - start
    finally:
        geometry.EXCHANGE_DIRECTIONS = kept
    return {"seconds": seconds, "error": abs(total / 200.0 / FACING - 1.0), "settings": {"directions": directions}}


def run(quick: bool = False) -> dict[str, Any]:
    """Curves {name, points: [{seconds, error, settings}]}."""
    spots, meshes = ((30, 120), (2,)) if quick else ((15, 30, 75, 150, 300, 600), (2, 3))
    curves = [{"name": f"completion {10 * 4**n + 2}", "points": [completion(n, s) for s in spots]} for n in meshes]
    curves.append({"name": "lobe", "points": [lobe(meshes[-1], s) for s in spots if s >= 75]})
    curves.append({"name": "medium", "points": [medium(n) for n in ((2,) if quick else (1, 2, 3, 4))]})
    curves.append({"name": "exchange", "points": [exchange(4**n) for n in range(1, 4 if quick else 6)]})
    fine = boundary(256 if quick else 768, np.zeros(0))["value"]
    points = [boundary(n, fine) for n in (12, 24, 48, 96)]
    curves.append({"name": "boundary", "points": [{k: v for k, v in p.items() if k != "value"} for p in points]})
    return {"name": "reconstruct", "quick": quick, "curves": curves}
