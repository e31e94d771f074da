"""Blends of ellipsoids and capsules: smooth bodies with necks, limbs, thin parts, dents and folds, as meshes.

A part is the zero of a function that is close to the signed distance from its surface, in mm and negative inside;
joining takes the lower of two, carving the higher of one and the other's negative, both rounded (Quilez, smooth
minimum). The zero of the whole is meshed by marching cubes, remeshed to nearly equal triangles (Botsch and Kobbelt
2004) and moved onto the zero again.
"""

from __future__ import annotations

from collections.abc import Callable

import gpytoolbox
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from disco_twin.scene.shape_schema import Blend, Capsule, Ellipsoid
from hw.base.arrays import F64
from hw.base.errors import InputError

KEY = "object.shape"
CELLS = 80  # of marching cubes, along the longest side of the box around the parts
SNAP = 0.02  # of a cell
TRIANGLES = 16_000
REMESHINGS = 5  # rounds of splits, collapses, flips and smoothing
LANDINGS = 4  # Newton steps onto the surface
LANDED, SAME_VOLUME = 0.02, 0.1  # of an edge, of marching cubes' volume: beyond these a thin part has collapsed
GRADIENT_MM = 1e-4

Function = Callable[[F64], F64]


def blend(config: Blend) -> trimesh.Trimesh:
    """The closed surface of a blend, of about `TRIANGLES` triangles of nearly equal area.

    Raises: InputError where its parts do not touch, where one is too thin for the mesh, or nothing is left.
    """
    function = blend_function(config)
    surface = _marching_cubes(config, function)
    edge = float(np.sqrt(surface.area / TRIANGLES * 4 / np.sqrt(3)))
    points, faces = gpytoolbox.remesh_botsch(
        np.array(surface.vertices), np.array(surface.faces, np.int32), REMESHINGS, edge, True
    )
    mesh = trimesh.Trimesh(_landed(points, function, edge), faces, process=False)
    off = float(np.abs(function(np.asarray(mesh.vertices))).max())
    whole = mesh.is_watertight and mesh.is_winding_consistent and abs(mesh.volume / surface.volume - 1) < SAME_VOLUME
    if not whole or off > LANDED * edge:
        problem, remedy = (
            "a part or what is left between two is too thin for the mesh",
            "make it thicker than two edges",
        )
        raise InputError(problem, key=KEY, allowed=f"triangles have edges of {edge:.2g} mm", remedy=remedy)
    return mesh


def blend_function(config: Blend) -> Function:
    """(N, 3) points in mm -> (N,) about the signed distance from the blend's surface, mm, negative inside."""

    def function(points: F64) -> F64:
        whole = _distance(config.parts[0], points)
        for part in config.parts[1:]:
            own = _distance(part, points)
            rounding = config.rounding_mm
            whole = -_lower(-whole, own, rounding) if part.carve else _lower(whole, own, rounding)
        return whole

    return function


def _lower(a: F64, b: F64, rounding: float) -> F64:
    """The lower of two, rounded where they differ by less than `rounding`; there it is lower than both."""
    overlap = np.maximum(rounding - np.abs(a - b), 0) / rounding
    return np.asarray(np.minimum(a, b) - overlap**2 * rounding / 4)


def _distance(part: Ellipsoid | Capsule, points: F64) -> F64:
    return _ellipsoid(part, points) if isinstance(part, Ellipsoid) else _capsule(part, points)


def _ellipsoid(part: Ellipsoid, points: F64) -> F64:
    """Distance to first order in it: (k - 1) k / |grad k^2 / 2| with k = |p / radii|; exact for a ball."""
    turn = Rotation.from_euler("xyz", part.turn_deg, degrees=True)
    own = turn.inv().apply(points - np.array(part.centre_mm))
    radii = np.array(part.radii_mm)
    k = np.linalg.norm(own / radii, axis=1)
    slope = np.linalg.norm(own / radii**2, axis=1)
    return np.asarray(np.where(k > 1e-6, k * (k - 1) / np.maximum(slope, 1e-12), -radii.min()))


def _capsule(part: Capsule, points: F64) -> F64:
    """Distance from the nearest of the balls between the ends: it is convex in the place along the axis."""
    start, axis = np.array(part.from_mm), np.subtract(part.to_mm, part.from_mm)
    length = float(np.linalg.norm(axis))
    taper = part.radius_mm - (part.to_radius_mm or part.radius_mm)
    lean = taper / length / np.sqrt(1 - (taper / length) ** 2)
    along = (points - start) @ (axis / length)
    across = np.sqrt(np.maximum(((points - start) ** 2).sum(axis=1) - along**2, 0))
    share = np.clip((along - across * lean) / length, 0, 1)
    return np.asarray(np.hypot(along - share * length, across) - (part.radius_mm - share * taper))


def _marching_cubes(config: Blend, function: Function) -> trimesh.Trimesh:
    low, high = (np.array([_bounds(p)[k] for p in config.parts if not p.carve]) for k in (0, 1))
    low, high = low.min(axis=0) - config.rounding_mm, high.max(axis=0) + config.rounding_mm
    cell = float((high - low).max()) / CELLS
    counts = np.ceil((high - low) / cell).astype(int) + 3
    axes = [low[k] + cell * (np.arange(counts[k]) - 1) for k in range(3)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    grid = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    values = function(grid)
    if not (values < 0).any():
        if any(part.carve for part in config.parts):
            raise InputError("carving leaves nothing of the blend", key=f"{KEY}.parts", remedy="carve less")
        raise InputError(f"all parts are thinner than {cell:.2g} mm", key=f"{KEY}.parts", remedy="make them larger")
    off = SNAP * cell  # no grid point on the surface or next to it: there would be triangles without area
    values = np.where(np.abs(values) < off, np.copysign(off, values), values)
    nx, ny, nz = (int(n) for n in counts)
    points, faces = gpytoolbox.marching_cubes(values, grid, nx, nz, ny, 0.0)  # what it calls ny is the slowest axis
    mesh = trimesh.Trimesh(points, faces, process=False)
    if mesh.volume < 0:
        mesh.invert()
    pieces = len(mesh.split(only_watertight=False))
    if pieces > 1:
        problem = f"the blend is {pieces} surfaces that do not touch, or has parts thinner than {cell:.2g} mm"
        raise InputError(problem, key=f"{KEY}.parts", remedy="let parts overlap, thicken them, carve from outside only")
    return mesh


def _bounds(part: Ellipsoid | Capsule) -> tuple[F64, F64]:
    if isinstance(part, Ellipsoid):
        axes = Rotation.from_euler("xyz", part.turn_deg, degrees=True).as_matrix() * np.array(part.radii_mm)
        reach, centre = np.linalg.norm(axes, axis=1), np.array(part.centre_mm)
        return centre - reach, centre + reach
    ends = np.array([part.from_mm, part.to_mm])
    radii = np.array([[part.radius_mm], [part.to_radius_mm or part.radius_mm]])
    return (ends - radii).min(axis=0), (ends + radii).max(axis=0)


def _landed(points: F64, function: Function, edge: float) -> F64:
    """Points moved onto the zero, by no more than a third of an edge at a step."""
    steps = GRADIENT_MM * np.eye(3)
    for _ in range(LANDINGS):
        value = function(points)
        slope = np.stack([function(points + s) - function(points - s) for s in steps], axis=1) / (2 * GRADIENT_MM)
        step = -value / np.maximum((slope**2).sum(axis=1), 0.1)
        length = np.abs(step) * np.linalg.norm(slope, axis=1)
        step *= np.minimum(1, edge / 3 / np.maximum(length, 1e-12))
        points = points + step[:, None] * slope
    return points
