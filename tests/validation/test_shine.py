"""The surface layer of references from pixels: what a boundary reflects of a sky, against quadrature.

Rationale: a convex body reflects each ray once, so a pixel shows the sky's radiance times the directional albedo of the
boundary's reflection, at the angles of the triangles that the pixel sees. For a smooth boundary that is Fresnel's
reflectance in the mirror's direction; for a rough one the integral of its microfacets (Walter et al. 2007, eq. 20, with
GGX and Smith's shadowing, eqs. 33 and 34).

Expected behaviour: z-scores of every pixel that the body fills, from replicates and corrected for their number; black
where the body is not, and on a matched boundary.
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from significance import assert_z, z_of_replicates
from twins import Kind, camera, twin

from disco_twin.light.rendering import reflected_sky
from disco_twin.light.transport import Transport
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.fresnel import transmittance
from pipeline.geometry.mesh import RayMesh
from pipeline.geometry.pixel_footprints import SurfaceHits, trace_pixels
from pipeline.relight.lights import Environment, Lobe, Uniform

F64 = NDArray[np.float64]
REPLICATES, PIXELS, SUPERSAMPLE = 16, 20, 32
RADIANCE, COLOUR = 2.0, (1.0, 0.25)


def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=3, radius=5.0)


def directional_albedo(cosine: F64, eta: float, alpha: float) -> F64:
    """(N,) share of the power from a direction outside that rough facets reflect to the outside."""
    # m with the density D(m) (m . n): the projected area of facets, whose integral is 1.
    u, weight = np.polynomial.legendre.leggauss(240)
    u, weight = 0.5 * (u + 1), 0.5 * weight
    phi = 2 * np.pi * (np.arange(240) + 0.5) / 240
    m_n = np.sqrt((1 - u) / (1 + u * (alpha**2 - 1)))[:, None]
    m_x = np.sqrt(1 - m_n**2) * np.cos(phi)

    def shadowing(c: F64) -> F64:
        with np.errstate(divide="ignore"):
            return np.asarray(2 / (1 + np.sqrt(1 + alpha**2 * (1 - c**2) / c**2)))

    out = []
    for c in cosine:
        i_m = np.sqrt(1 - c**2) * m_x + c * m_n
        o_n = 2 * i_m * m_n - c
        seen = (i_m > 0) & (o_n > 0)
        reflected = 1 - transmittance(i_m, eta)
        each = reflected * shadowing(np.array(c)) * shadowing(np.where(seen, o_n, 1.0)) * i_m / (c * m_n)
        out.append(float(weight @ np.where(seen, each, 0.0).mean(axis=1)))
    return np.array(out)


def test_the_albedo_of_facets_is_fresnels_where_they_lie_flat() -> None:
    cosine = np.array([0.3, 0.6, 1.0])
    np.testing.assert_allclose(directional_albedo(cosine, 1.5, 1e-3), 1 - transmittance(cosine, 1.5), rtol=1e-4)


def over_pixels(mesh: trimesh.Trimesh, view: PinholeCamera, of: object) -> tuple[F64, NDArray[np.bool_]]:
    """(H * W) means of a function of (hits, flat cosines) over pixels, and which of them the body fills."""
    count, total = np.zeros(PIXELS**2), np.zeros(PIXELS**2)
    for hits in trace_pixels(mesh, view, SUPERSAMPLE):
        flat = -(RayMesh.of(mesh).normals[hits.triangle] * hits.direction).sum(axis=1)
        count += np.bincount(hits.pixel, minlength=PIXELS**2)
        total += np.bincount(hits.pixel, of(hits, flat), PIXELS**2)  # type: ignore[operator]
    return total / np.maximum(count, 1), count == SUPERSAMPLE**2


def replicates(transport: Transport, light: Uniform | Environment, view: PinholeCamera) -> F64:
    """(REPLICATES, L, H * W), two of each seed."""
    halves = [reflected_sky(transport, light, view, 0.1, seed) for seed in range(REPLICATES // 2)]
    return np.concatenate(halves).reshape(REPLICATES, len(COLOUR), -1).astype(float)


@pytest.mark.parametrize(("kind", "eta", "alpha"), [("smooth", 1.5, 0.0), ("rough", 1.3, 0.25), ("rough", 1.6, 0.4)])
def test_a_ball_under_uniform_light_shows_the_directional_albedo(kind: Kind, eta: float, alpha: float) -> None:
    mesh, view = ball(), camera((60.0, 10.0, 20.0), 12.0, PIXELS)
    table = np.linspace(0.1, 1.0, 100) ** 2
    rough = directional_albedo(table, eta, alpha) if alpha else None

    def albedo(_: SurfaceHits, cosine: F64) -> F64:
        return 1 - transmittance(cosine, eta) if rough is None else np.interp(cosine, table, rough)

    expected, filled = over_pixels(mesh, view, albedo)
    transport = Transport(twin(mesh, kind, eta, 1.0, [0.9, 0.9], alpha=alpha), cells=32)
    found = replicates(transport, Uniform(radiance=RADIANCE, colour=COLOUR), view)
    for laser, colour in enumerate(COLOUR):
        own, exact = found[:, laser, filled], RADIANCE * colour * expected[filled]
        assert_z(z_of_replicates(own, exact), f"{kind}, eta {eta}, alpha {alpha}")
        assert abs(z_of_replicates(own.sum(axis=1), 1.03 * exact.sum())) > 5  # three per cent would show
    assert not found[:, :, expected == 0].any()


def test_a_smooth_ball_mirrors_the_environment() -> None:
    """A sky with a lobe, by Fresnel's reflectance times the radiance from where the mirror looks."""
    mesh, view = ball(), camera((60.0, 10.0, 20.0), 12.0, PIXELS)
    lobe = Lobe(direction=(0.6, 0.0, 0.8), sharpness=8.0, radiance=(3.0, 0.5))
    light, axis = Environment(constant=(0.2, 0.1), lobes=(lobe,)), np.array([0.6, 0.0, 0.8])
    transport = Transport(twin(mesh, "smooth", 1.4, 1.0, [0.9, 0.9]), cells=32)
    found = replicates(transport, light, view)

    def mirrored(hits: SurfaceHits, cosine: F64, laser: int) -> F64:
        normal = RayMesh.of(mesh).normals[hits.triangle]
        towards = hits.direction + 2 * cosine[:, None] * normal
        radiance = light.constant[laser] + lobe.radiance[laser] * np.exp(lobe.sharpness * (towards @ axis - 1))
        return np.asarray(radiance * (1 - transmittance(cosine, 1.4)))

    for laser in range(len(COLOUR)):
        exact, filled = over_pixels(mesh, view, lambda hits, c, k=laser: mirrored(hits, c, k))
        assert_z(z_of_replicates(found[:, laser, filled], exact[filled]), f"environment, wavelength {laser}")


def test_a_matched_boundary_reflects_nothing() -> None:
    transport = Transport(twin(ball(), "matched", 1.0, 1.0, [0.9, 0.9]), cells=32)
    assert not reflected_sky(transport, Uniform(colour=COLOUR), camera((60.0, 10.0, 20.0), 12.0, PIXELS), 0.1, 1).any()
