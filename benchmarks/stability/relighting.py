"""Relighting: single precision against double, twelve decades, light that hardly arrives."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np
import trimesh

from benchmarks.stability.case import Family, relative
from hw.base.arrays import F64
from pipeline.geometry.camera import PinholeCamera, look_at
from pipeline.geometry.fresnel import Boundary
from pipeline.geometry.mesh import RayMesh
from pipeline.model.factorise import factorised
from pipeline.model.reflectance import GlobalTerm
from pipeline.model.relightable import RelightableModel
from pipeline.model.tilt import TiltLaw
from pipeline.relight.irradiance import flux_of, hat_moments
from pipeline.relight.lights import Beam, Directional, Uniform

FAMILY = Family("relighting")
CAMERA = PinholeCamera(
    32, 32, np.full(2, 600.0), np.full(2, 16.0), np.zeros(5), look_at((400.0, 30.0, 50.0), (0, 0, 0))
)


@cache
def ball(subdivisions: int = 2, size: float = 20.0) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=size / 2)


def entries(length: float, mesh: trimesh.Trimesh) -> F64:
    """(1, V, V) R_d that falls by e every `length` mm."""
    points = np.asarray(mesh.vertices)
    return np.asarray(0.01 * np.exp(-np.linalg.norm(points[:, None] - points, axis=2) / length))[None]


def model(length: float, subdivisions: int = 2) -> RelightableModel:
    mesh = ball(subdivisions)
    term = GlobalTerm(entries(length, mesh).astype(np.float32), np.ones((len(mesh.vertices),) * 2, bool))
    return RelightableModel(mesh, Boundary(1.3), (term,))


def flux(light: Any, mesh: trimesh.Trimesh) -> F64:
    return flux_of(hat_moments(light, mesh, Boundary(1.3), 1), mesh)


BEHIND = Beam(name="b", direction=(1.0, 0.0, 0.0), diameter_mm=2.0, colour=(1.0,))


def radiosity_off(length: float, exact: bool) -> float:
    """Largest relative error of the radiosity of a beam, over all vertices, against sums in double precision.

    exact: the matrix itself; else its factors, by their own bound: the error over the bound.
    """
    mesh, own = ball(), model(length)
    q = flux(BEHIND, mesh)
    true = q[0] @ entries(length, mesh)[0]
    if exact:
        return relative(own.terms[0].radiosity(q[None], np.asarray(mesh.vertices))[0, 0], true)  # type: ignore[attr-defined]
    term = factorised(own).terms[0]
    area = RayMesh.of(mesh).vertex_areas
    found = term.radiosity(q[None], np.asarray(mesh.vertices))[0, 0]  # type: ignore[attr-defined]
    off = np.sqrt((area * (found - true) ** 2).sum() / area.sum())
    return float(off / term.error_bound(q[None], area)[0, 0])  # type: ignore[attr-defined]


for length, decades in ((4.0, 2), (0.7, 12), (0.3, 29)):
    FAMILY.case(
        f"a beam's light, R_d over {decades} decades",
        "sums in double precision, at every vertex to 1e-5",
        f"{decades} decades",
        1e-5,
    )(partial(radiosity_off, length, True))
    FAMILY.case(
        f"the same by factors, R_d over {decades} decades",
        "off by no more than the stated bound",
        f"{decades} decades",
        1.0,
        slow=True,
    )(partial(radiosity_off, length, False))


def image_off(length: float, power: float) -> float:
    """A light `power` times as strong makes an image so many times as bright."""
    own = model(length)
    one, other = (own.image(own.lit_by(Uniform(radiance=r, colour=(1.0,))), own.seen_by(CAMERA)) for r in (1.0, power))
    return relative(other[one > 0], power * one[one > 0].astype(np.float64))


for power in (1e-12, 1e9):
    FAMILY.case(f"light of {power:g} times the radiance", "so many times as bright", f"{power:g}", 1e-5, slow=True)(
        partial(image_off, 2.0, power)
    )


def power_off(light: Any, expected: float, size: float = 20.0) -> float:
    """Plain flux on a ball against its projected area's."""
    mesh = ball(3, size)
    return relative(hat_moments(light, mesh, 1.0, 1).sum(), expected)


def parallel_off(size: float) -> float:
    return power_off(Directional(direction=(1.0, 0.2, 0.1), colour=(1.0,)), np.pi * size**2 / 4, size)


def beam_off(diameter: float) -> float:
    return power_off(Beam(name="b", direction=(1.0, 0.1, 0.0), diameter_mm=diameter, colour=(1.0,)), 1.0)


for size in (1.0, 300.0):
    FAMILY.case(
        f"parallel light on a ball of {size:g} mm",
        "irradiance times the disc, but for the facets",
        f"{size:g} mm",
        0.02,
    )(partial(parallel_off, size))
for diameter in (0.01, 2.0, 15.0):
    FAMILY.case(
        f"a beam of {diameter:g} mm on a ball of 20 mm",
        "all its power, to half a per cent",
        f"{diameter / 1.5:.2g} of an edge",
        5e-3,
        slow=diameter > 0.01,
    )(partial(beam_off, diameter))
FAMILY.case("a beam that misses", "no light", "0")(
    lambda: power_off(
        Beam(name="b", direction=(1.0, 0.0, 0.0), through_mm=(0.0, 30.0, 0.0), diameter_mm=1.0, colour=(1.0,)), 0.0
    )
)


@FAMILY.case(
    "slopes of directions at distances from 1e-6 to 1e6 mm",
    "constant beyond the ends, finite at 0",
    "12 decades",
    1e-12,
)
def slopes() -> float:
    law = TiltLaw(np.array([0.1, 1.0, 10.0]), np.array([0.3, 0.2, 0.1]))
    found = law(np.array([0.0, 1e-6, 0.1, 10.0, 1e6]))
    return relative(found, [0.3, 0.3, 0.3, 0.1, 0.1])
