"""What the walk reads and what it adds to, and the look-ups in it. Filled by transport.py."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from disco_twin.light.opaque import Opaque
from disco_twin.light.sampling import Rng, exponential
from disco_twin.light.walls import rate_in

FAR = 1e30


class Tables(Opaque):
    """What the walk reads; see transport.py for where it comes from. Floats are opaque so that kernels are reused."""

    scene: Any
    bsdf: Any  # of the outer surface
    walls: Any  # `Walls` of bodies inside, or None
    lasers: int
    matched: bool
    shine: bool  # the surface reflects light and lets none in
    even: bool  # connections are even (connect.py)
    eta: float
    homogeneous: bool
    isotropic: bool  # g = 0 everywhere
    g: Any  # of the medium, where it is one
    g_voxels: Any  # Float, per voxel, where it varies; else None
    majorant: Any  # 1/mm, of the whole object
    local: bool  # whether `distance` holds a local majorant beside each distance
    stretch: Any  # mm along each axis for which a local majorant holds
    medium: Any  # Float, per voxel (sigma_t / majorant, albedo...), padded to 2 or 4 channels
    albedo: Any  # weight type, the homogeneous medium's
    dims: Any
    medium_low: Any
    medium_scale: Any
    distance: Any  # Float, per cell: distance, or (distance, local majorant)
    normal: Any
    cells: int
    low: Any
    inverse_cell: Any
    bound: Any
    faces: Any
    vertices: Any
    vertex_count: int
    lift: Any
    kappa: Any  # concentration of the lobe
    reach: Any  # mm: collisions nearer to the surface than this send lobe connections
    length: Any  # mm: longest lobe connection


class Cameras(Opaque):
    """Cameras of equal size as rows of ROW floats: position, right, down, forward, focal, centre, distortion."""

    count: int
    width: int
    height: int
    rows: Any


ROW = 21


class Sky(Opaque):
    """A light from all around, for walks that start at pixels, each pixel a tag: they meet it where they leave."""

    source: Any  # EnvironmentSource


class Images(Opaque):
    """Integer accumulators of the images: sums from exits and from lobe connections.

    Index (((tag * layers + layer) * cameras + camera) * pixels + pixel) * lasers + laser; layers are 1 (all light) or 2
    (light from below the surface, light reflected at it). One count is `quantum`.
    """

    layers: int
    exits: Any
    lobes: Any
    inverse_quantum: Any


class Deposits(Opaque):
    """Integer accumulators of the power that leaves through the surface, shared among each triangle's vertices.

    Index (tag * lasers + laser) * vertices + vertex; one count is `scale` = `1 / inverse_quantum` watts.
    """

    total: Any
    inverse_quantum: Any
    scale: float


def boundary_context(t: Tables) -> Any:
    """For Mitsuba's BSDF: power is conserved, and where the surface but shines it reflects (component 0) alone."""
    context = mi.BSDFContext(mi.TransportMode.Importance)
    if t.shine:
        context.component = 0
    return context


def cell_index(t: Tables, q: Any) -> Any:
    """Flat index of the distance field's cell at q, clamped to the grid's rim."""
    cell = mi.Point3i(dr.floor((q - t.low) * t.inverse_cell))
    cell = dr.minimum(dr.maximum(cell, 0), t.cells - 1)
    return mi.UInt32((cell.z * t.cells + cell.y) * t.cells + cell.x)


def surroundings(t: Tables, q: Any, region: Any = None) -> tuple[Any, Any]:
    """Radius of a ball about q that holds no surface (none if <= 0), and the majorant for a flight from q.

    region: that q lies in, where the object has bodies inside.
    """
    grid = (q - t.low) * t.inverse_cell
    cell = dr.floor(grid)
    off_centre = dr.norm(grid - cell - 0.5) / t.inverse_cell
    whole = dr.minimum(dr.maximum(mi.Point3i(cell), 0), t.cells - 1)
    index = mi.UInt32((whole.z * t.cells + whole.y) * t.cells + whole.x)
    if t.local:
        found = dr.gather(mi.Vector2f, t.distance, index)
        empty, rate = found[0] - off_centre, found[1]
    else:
        empty, rate = dr.gather(mi.Float, t.distance, index) - off_centre, mi.Float(t.majorant)
    return empty, rate if region is None else rate_in(t.walls, region, rate)


def near_surface(t: Tables, empty: Any) -> Any:
    """Whether collisions with `empty` mm around them send lobe connections."""
    return mi.Bool(True) if t.matched else empty < t.reach


def free_flight(t: Tables, direction: Any, rate: Any, rng: Rng) -> tuple[Any, Any]:
    """Length of a flight under the majorant `rate`, and the rate to test the collision at its end against: infinite,
    for no collision, where the flight ends because the majorant holds no farther.
    """
    flight = exponential(rng) / rate
    if not t.local:
        return flight, mi.Float(rate)
    longest = t.stretch / dr.max(dr.abs(direction))
    return dr.minimum(flight, longest), dr.select(flight < longest, rate, dr.inf)


def medium_at(t: Tables, q: Any, rng: Rng) -> tuple[Any, Any, Any]:
    """Probability of a real collision, the albedo per wavelength and the asymmetry at q.

    One voxel of the eight is drawn with its trilinear weight: sigma_t, sigma_s = albedo * sigma_t and sigma_s times the
    phase function are then interpolated linearly in expectation, which is all that an unbiased walk needs, at one
    look-up instead of eight.
    """
    if t.homogeneous and t.g_voxels is None:
        return mi.Float(1.0), t.albedo, t.g
    grid = (q - t.medium_low) * t.medium_scale - 0.5
    voxel = mi.Point3i(dr.floor(grid + mi.Point3f(rng.next(), rng.next(), rng.next())))
    voxel = mi.Point3i(
        dr.clip(voxel.x, 0, t.dims.x - 1), dr.clip(voxel.y, 0, t.dims.y - 1), dr.clip(voxel.z, 0, t.dims.z - 1)
    )
    index = mi.UInt32((voxel.z * t.dims.y + voxel.y) * t.dims.x + voxel.x)
    g = t.g if t.g_voxels is None else dr.gather(mi.Float, t.g_voxels, index)
    if t.homogeneous:
        return mi.Float(1.0), t.albedo, g
    if t.lasers == 1:
        value = dr.gather(mi.Vector2f, t.medium, index)
        return value[0], mi.Color1f(value[1]), g
    value = dr.gather(mi.Vector4f, t.medium, index)
    if t.lasers == 2:
        return value[0], mi.Vector2f(value[1], value[2]), g
    return value[0], mi.Color3f(value[1], value[2], value[3]), g
