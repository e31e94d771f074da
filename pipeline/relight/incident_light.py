"""What arrives at a surface point from a light, before the surface shades itself.

Lights with one direction per point (directional, beam, projector) answer in closed form; lights from many directions
(uniform, environment) answer with a deterministic low-discrepancy set of directions, distributed as their radiance.
"""

from __future__ import annotations

import numpy as np

from hw.base.arrays import F64
from hw.base.errors import InputError
from pipeline.geometry.camera import look_at
from pipeline.geometry.directions import about, cosine_directions, lattice
from pipeline.relight.lights import Beam, Directional, Environment, Light, TexturedProjector, Uniform


def colour(light: Uniform | Directional | Beam | TexturedProjector, lasers: int) -> F64:
    """(L,) factors of the first `lasers` wavelengths. Raises: InputError where the light has fewer."""
    return _first(light.colour, lasers, light.name)


def _first(values: tuple[float, ...], lasers: int, name: str) -> F64:
    if len(values) < lasers:
        raise InputError(
            f"light '{name}' has {len(values)} colour values for {lasers} lasers", remedy="give one per laser"
        )
    return np.array(values[:lasers], np.float64)


def _unit(vector: tuple[float, float, float]) -> F64:
    v = np.array(vector, np.float64)
    return np.asarray(v / np.linalg.norm(v))


def from_one_direction(light: Directional | Beam | TexturedProjector, points: F64) -> tuple[F64, F64]:
    """(N, 3) points in mm -> (N, 3) unit directions towards the light, (N,) irradiance across them in W/mm^2."""
    if isinstance(light, TexturedProjector):
        return _from_projector(light, points)
    along = _unit(light.direction)
    towards = np.broadcast_to(-along, points.shape)
    if isinstance(light, Beam):
        radius = light.diameter_mm / 2
        return towards, np.where(_from_axis(light, points) <= radius, light.power_w / (np.pi * radius**2), 0.0)
    across = np.full(len(points), light.irradiance)
    if light.edge_side is not None:
        across[points @ edge_normal(light) < light.edge_offset_mm] = 0.0
    return towards, across


def edge_normal(light: Directional) -> F64:
    """(3,) unit vector across the direction of light, pointing to the lit side of its shadow edge.

    Raises: ValueError for a light without an edge.
    """
    if light.edge_side is None:
        raise ValueError(f"light '{light.name}' has no edge")
    along, side = _unit(light.direction), np.array(light.edge_side, np.float64)
    side = side - (side @ along) * along
    return np.asarray(side / np.linalg.norm(side))


def _from_projector(light: TexturedProjector, points: F64) -> tuple[F64, F64]:
    pose = look_at(light.position_mm, light.aim_mm, light.up)
    distance = float(np.linalg.norm(np.subtract(light.aim_mm, light.position_mm)))
    local = points @ pose[:3, :3].T + pose[:3, 3]
    range2 = (local**2).sum(axis=1)
    ahead = local[:, 2] > 0
    depth = np.where(ahead, local[:, 2], 1.0)
    a, b = local[:, 0] / depth * distance, local[:, 1] / depth * distance
    wave = np.sin(2 * np.pi * a / light.period_mm) * np.sin(2 * np.pi * b / light.period_mm)
    inside = ahead & (np.abs(a) <= light.half_width_mm) & (np.abs(b) <= light.half_width_mm)
    slide = np.where(inside, (1 + light.contrast * wave) / (1 + light.contrast), 0.0)
    falloff = (depth / np.sqrt(range2)) ** 3
    return -local @ pose[:3, :3] / np.sqrt(range2)[:, None], light.intensity * slide * falloff / range2


def finest_mm(light: Light, centres: F64, radii: F64) -> F64:
    """(N,) size of the light's own finest structure inside balls (N, 3), (N,) in mm; infinite where it has none."""
    if isinstance(light, TexturedProjector):
        return np.full(len(centres), min(light.period_mm / 2, light.half_width_mm))
    if isinstance(light, Beam):
        from_axis = _from_axis(light, centres)
        return np.where(from_axis <= light.diameter_mm / 2 + radii, light.diameter_mm, np.inf)
    return np.full(len(centres), np.inf)


def _from_axis(light: Beam, points: F64) -> F64:
    return np.asarray(np.linalg.norm(np.cross(points - np.array(light.through_mm), _unit(light.direction)), axis=1))


def from_many_directions(light: Uniform | Environment, normals: F64, count: int, lasers: int) -> list[tuple[F64, F64]]:
    """Direction sets for points with the given (N, 3) outward normals, one set per component of the light.

    Each set is (N, count, 3) unit directions towards the light and (L, N, count) weights in W/mm^2, such that
    sum_k weight_k f(direction_k) approximates the integral of L(w) f(w) cos dw. Cosines below zero weigh 0.
    Raises: InputError where the light has fewer colours than `lasers`.
    """
    if isinstance(light, Uniform):
        light = Environment(constant=tuple(light.radiance * x for x in light.colour), name=light.name)
    index, sets = np.arange(len(normals)), []
    first, azimuth = lattice(index, count)
    constant = _first(light.constant, lasers, light.name)
    if constant.any():
        weight = np.broadcast_to(constant[:, None, None] * np.pi / count, (lasers, *first.shape))
        sets.append((cosine_directions(normals, count, index), weight))
    for lobe in light.lobes:
        kappa = lobe.sharpness
        away = -np.log1p(first * np.expm1(-2 * kappa)) / kappa  # 1 - cosine, density of von Mises and Fisher
        axis = np.broadcast_to(_unit(lobe.direction), normals.shape)
        directions = about(axis, 1 - away, azimuth)
        solid_angle = -2 * np.pi * np.expm1(-2 * kappa) / kappa  # integral of exp(kappa (cos - 1))
        seen = np.maximum(np.einsum("nkx,nx->nk", directions, normals), 0.0)
        radiance = _first(lobe.radiance, lasers, light.name)
        sets.append((directions, radiance[:, None, None] * (seen * solid_angle / count)))
    return sets
