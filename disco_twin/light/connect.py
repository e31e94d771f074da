"""Connections of photons to the cameras: through the boundary's BSDF at exits, by lobes from below the surface.

Seen from inside, the directions that refract towards a camera fill a narrow lobe, so few exits point there. A collision
near the surface therefore sends an extra flight into a von Mises-Fisher lobe about that direction; its contribution
and that of ordinary exits are combined by the balance heuristic (Veach 1997, section 9.2.2). Across an index-matched
boundary the connection is straight instead.

For captures an outer step of the walk draws one of its collisions, all alike, which sends one lobe to each camera.
References are made by *even* connections (docs/decisions/0054, 0136): to one camera, collisions send lobes in
proportion to what they promise, about the axis of the facet that the lobe meets; lobes are wider towards grazing
angles, and a share of them is wide everywhere, lest the tails of what the boundary refracts be left to rare and bright
exits.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from disco_twin.light import MOST_CAMERAS, sampling
from disco_twin.light.sampling import Rng
from disco_twin.light.tables import (
    FAR,
    ROW,
    Cameras,
    Images,
    Sky,
    Tables,
    boundary_context,
    cell_index,
    medium_at,
)
from disco_twin.light.walls import is_outer

CONNECTIONS = 2.0  # even ones that an isotropic collision right below a surface sends along its normal, in the mean
LEAST, MOST = 0.05, 4.0  # times that a collision sends, whatever it promises
GRAZING = 0.1  # cosine: what leaves at smaller ones promises as much
SHARPER = 1.25  # concentration of a lobe along the normal, beside that of captures
WIDE, WIDER = 0.2, 10.0  # share of the lobes that are so many times less concentrated


def drawn_camera(cams: Cameras, k: Any, rng: Rng) -> tuple[Any, float]:
    """The k-th camera to connect to, and what its contribution counts for.

    Of many cameras each connection reaches MOST_CAMERAS only, drawn one from each of as many equal stretches of the
    list: a walk then costs the same for 24 cameras as for six (docs/decisions/0051).
    """
    if cams.count <= MOST_CAMERAS:
        return k, 1.0
    stretch = cams.count / MOST_CAMERAS
    return dr.minimum(mi.UInt32((mi.Float(k) + rng.next()) * stretch), cams.count - 1), stretch


def refracted_axis(t: Tables, normal: Any, towards: Any) -> Any:
    """Inside direction that a smooth boundary refracts into `towards` (Snell), the lobe's axis."""
    tangent = (towards - normal * dr.dot(normal, towards)) * (1.0 / t.eta)
    return dr.normalize(tangent + normal * dr.safe_sqrt(1.0 - dr.squared_norm(tangent)))


def lobe_at(t: Tables, q: Any, target: Any) -> tuple[Any, Any, Any]:
    """Axis and concentration of the lobe at collision q towards `target`, and whether it is used there."""
    normal = dr.gather(mi.Vector3f, t.normal, cell_index(t, q))
    towards = dr.normalize(target - q)
    outside = dr.dot(normal, towards)
    usable = (outside > -0.1) & (dr.squared_norm(normal) > 0.5)
    if not t.even:
        return refracted_axis(t, normal, towards), t.kappa, usable
    # Of the nearest surface the normal is known without a ray; the facet that the lobe meets may be another one.
    guess = dr.select(usable, refracted_axis(t, normal, towards), towards)
    hit = t.scene.ray_intersect(mi.Ray3f(q, guess, t.length, 0.0, mi.Color0f()), mi.RayFlags.Minimal, False, True)
    outside = dr.dot(hit.n, towards)
    usable = hit.is_valid() & (outside > 0.0)
    if t.walls is not None:
        usable &= is_outer(t.walls, hit)
    kappa = mi.Float(t.kappa)
    if t.eta > 1.0:
        # A facet that is tilted by v turns what it refracts by v (1 - cos_o / (eta cos_i)) in the plane of incidence,
        # at grazing angles eta / (eta - 1) times as far as at normal ones, and across that plane about as far.
        outside = dr.maximum(outside, 0.0)
        inside = dr.sqrt(t.eta * t.eta - 1.0 + outside * outside)  # eta cos_i
        kappa = kappa * (SHARPER * (1.0 - 1.0 / t.eta)) / (1.0 - outside / inside)
    return refracted_axis(t, hit.n, towards), kappa, usable


def lobe_pdf(t: Tables, kappa: Any, cosine: Any) -> Any:
    """Density of the lobe at `cosine` from its axis."""
    narrow = sampling.von_mises_fisher_pdf(cosine, kappa)
    if not t.even:
        return narrow
    return (1.0 - WIDE) * narrow + WIDE * sampling.von_mises_fisher_pdf(cosine, kappa / WIDER)


def lobes_of(t: Tables, cams: Cameras, q: Any, before: Any, g: Any, empty: Any) -> Any:
    """How many even lobe connections a collision sends in the mean: in proportion to what one may bring, the phase
    function towards the lobe's axis times the way out times the cosine at which it leaves.

    q: its place, `empty` mm below the surface; before: the direction of the flight to it; g: the asymmetry there.
    """
    towards = dr.normalize(eye(cams, 0) - q)
    free_paths = 6.0 / t.reach * empty
    axis, cosine = towards, mi.Float(1.0)
    if not t.matched:
        normal = dr.gather(mi.Vector3f, t.normal, cell_index(t, q))
        cosine = dr.maximum(dr.dot(normal, towards), 0.0)
        axis = dr.select(cosine > 0.0, refracted_axis(t, normal, towards), towards)
        free_paths *= t.eta * dr.rsqrt(t.eta * t.eta - 1.0 + cosine * cosine)
    phase = sampling.henyey_greenstein_pdf(dr.dot(before, axis), g) * (1.0 / sampling.UNIFORM)
    share = phase * dr.exp(-free_paths) * dr.maximum(cosine, GRAZING)
    return CONNECTIONS * dr.clip(share, LEAST, MOST)


@dr.syntax
def transmittance(t: Tables, origin: Any, direction: Any, length: Any, rng: Rng) -> tuple[Any, Rng]:
    """Unbiased transmittance along a segment inside the medium: exact, or by ratio tracking (Novak et al. 2014).

    Returns the generator too, as everything here does: Dr.Jit's branches replace the objects that they change.
    """
    result = mi.Float(1.0)
    if dr.hint(t.homogeneous, mode="scalar"):
        result = dr.exp(-t.majorant * length)
    else:
        travelled = mi.Float(0.0)
        going = mi.Bool(True)
        while dr.hint(going, label="transmittance"):
            travelled += sampling.exponential(rng) / t.majorant
            going = travelled < length
            if dr.hint(going):
                real, _, _ = medium_at(t, dr.fma(direction, travelled, origin), rng)
                result *= 1.0 - real
    return result, rng


def eye(cams: Cameras, camera: Any) -> Any:
    """Where a camera stands."""
    return mi.Point3f(*[dr.gather(mi.Float, cams.rows, camera * ROW + k) for k in range(3)])


def project(cams: Cameras, camera: Any, point: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Direction and distance from a point to a camera, pixel index, the factor 1 / (distance^2 * pixel solid angle)
    that turns intensity into pixel radiance, and whether it falls on the sensor.
    """
    base = camera * ROW
    read = [dr.gather(mi.Float, cams.rows, base + k) for k in range(ROW)]
    position = mi.Point3f(*read[0:3])
    right, down, forward = mi.Vector3f(*read[3:6]), mi.Vector3f(*read[6:9]), mi.Vector3f(*read[9:12])
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = read[12:21]
    towards = position - point
    squared = dr.squared_norm(towards)
    towards = towards * dr.rsqrt(squared)
    cosine = -dr.dot(towards, forward)
    x, y = -dr.dot(towards, right) / cosine, -dr.dot(towards, down) / cosine
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    dxx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    dxy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    dyy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    jacobian = dxx * dyy - dxy * dxy
    u = (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) * fx + cx
    v = (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y) * fy + cy
    inside = (cosine > 0.0) & (jacobian > 0.0) & (u >= 0.0) & (v >= 0.0) & (u < cams.width) & (v < cams.height)
    pixel = mi.UInt32(v) * cams.width + mi.UInt32(u)
    factor = fx * fy * jacobian / (squared * cosine * cosine * cosine)
    return position, towards, pixel, factor, inside


def splat(total: Any, images: Images, pixel: Any, value: Any, lasers: int, rng: Rng, ok: Any) -> None:
    """Add a contribution per wavelength to a pixel of all images, stochastically rounded to whole quanta."""
    dither = rng.next()
    for k in range(lasers):
        count = mi.UInt64(dr.select(ok, value[k], 0.0) * images.inverse_quantum + dither)
        dr.scatter_add(total, count, pixel * lasers + k, ok)


@dr.syntax
def straight_transmittance(t: Tables, origin: Any, target: Any, rng: Rng) -> tuple[Any, Rng]:
    """Transmittance from a collision straight to a camera through an index-matched boundary, cavities included."""
    direction = target - origin
    length = dr.norm(direction)
    direction = direction / length
    result = mi.Float(1.0)
    inside = mi.Bool(True)
    p = mi.Point3f(origin)
    going = mi.Bool(True)
    while dr.hint(going, label="straight"):
        hit = t.scene.ray_intersect(mi.Ray3f(p, direction, FAR, 0.0, mi.Color0f()), mi.RayFlags.Minimal, False, True)
        going = hit.is_valid()
        if dr.hint(going & inside):
            passed, rng = transmittance(t, p, direction, hit.t, rng)
            result *= passed
        going &= result > 0.0
        if dr.hint(going):
            outward = dr.dot(hit.n, direction) > 0.0
            inside = ~outward
            p = mi.Point3f(hit.p + hit.n * dr.select(outward, t.lift, -t.lift))
    return result, rng


@dr.syntax
def connect_lobes(
    t: Tables, cams: Cameras, images: Images, tag: Any, point: Any, before: Any, weight: Any, g: Any,
    lobes: Any, rng: Rng,
) -> Rng:  # fmt: skip
    """Connect one drawn collision to the cameras, which sends `lobes` of such connections in the mean. `before` is the
    flight's direction before the collision, g the asymmetry there.
    """
    pixels = cams.width * cams.height
    context = boundary_context(t)
    turn = mi.UInt32(0)
    while dr.hint(turn < min(cams.count, MOST_CAMERAS), label="lobes"):
        camera, times = drawn_camera(cams, turn, rng)
        base = (tag * (images.layers * cams.count) + camera) * pixels
        if dr.hint(t.matched, mode="scalar"):
            position, towards, pixel, factor, seen = project(cams, camera, point)
            if dr.hint(seen):
                through, rng = straight_transmittance(t, point, position, rng)
                phase = sampling.henyey_greenstein_pdf(dr.dot(before, towards), g)
                value = weight * (phase * through * factor * times)
                splat(images.lobes, images, base + pixel, value, t.lasers, rng, through > 0.0)
        else:
            axis, kappa, usable = lobe_at(t, point, eye(cams, camera))
            if dr.hint(usable):
                width = mi.Float(kappa)
                if dr.hint(t.even, mode="scalar"):
                    width = dr.select(rng.next() < WIDE, kappa / WIDER, kappa)
                omega = sampling.von_mises_fisher(rng, axis, width)
                lobe = lobe_pdf(t, kappa, dr.dot(axis, omega))
                phase = sampling.henyey_greenstein_pdf(dr.dot(before, omega), g)
                hit = t.scene.ray_intersect(
                    mi.Ray3f(point, omega, t.length, 0.0, mi.Color0f()), mi.RayFlags.Minimal, False, True
                )
                met = hit.is_valid()
                if dr.hint(t.walls is not None, mode="scalar"):
                    met &= is_outer(t.walls, hit)  # walls inside are not connected through (walls.py)
                if dr.hint(met):
                    hit.sh_frame = mi.Frame3f(hit.n)
                    hit.wi = hit.to_local(-omega)
                    position, towards, pixel, factor, seen = project(cams, camera, hit.p)
                    seen &= (dr.dot(hit.n, towards) > 0.0) & (dr.dot(hit.n, omega) > 0.0)
                    if dr.hint(seen):
                        value = t.bsdf.eval(context, hit, hit.to_local(towards), True)[0]
                        value *= factor * times * phase / (phase + lobes * lobe)
                        if dr.hint(value > 0.0):
                            passed, rng = transmittance(t, point, omega, hit.t, rng)
                            value *= passed
                            start = mi.Point3f(hit.p + hit.n * t.lift)
                            blocked = t.scene.ray_test(mi.Ray3f(start, towards, FAR, 0.0, mi.Color0f()), False, True)
                            splat(images.lobes, images, base + pixel, weight * value, t.lasers, rng, ~blocked)
        turn += 1
    return rng


@dr.syntax
def connect_exit(
    t: Tables, cams: Cameras, images: Images, tag: Any, si: Any, direction: Any, weight: Any,
    collision: Any, phase: Any, lobes: Any, surface_only: Any, rng: Rng,
) -> Rng:  # fmt: skip
    """Connect a photon that meets the surface to the cameras through the boundary's BSDF.

    collision, phase, lobes: the flight's last collision, the phase density of its direction and how many lobe
    connections could have made the same path in the mean (the balance heuristic shares it with them).
    """
    pixels = cams.width * cams.height
    context = boundary_context(t)
    turn = mi.UInt32(0)
    while dr.hint(turn < min(cams.count, MOST_CAMERAS), label="exits"):
        camera, times = drawn_camera(cams, turn, rng)
        position, towards, pixel, factor, seen = project(cams, camera, si.p)
        seen &= (dr.dot(si.n, towards) > 0.0) & (dr.max(weight) > 0.0)
        if dr.hint(seen):
            value = t.bsdf.eval(context, si, si.to_local(towards), True)[0] * (factor * times)
            axis, kappa, usable = lobe_at(t, collision, position)
            lobe = lobe_pdf(t, kappa, dr.dot(axis, direction))
            value *= dr.select((lobes > 0.0) & usable, phase / (phase + lobes * lobe), 1.0)
            if dr.hint(value > 0.0):
                start = mi.Point3f(si.p + si.n * t.lift)
                blocked = t.scene.ray_test(mi.Ray3f(start, towards, FAR, 0.0, mi.Color0f()), False, True)
                base = (first_image(images, tag, surface_only, cams.count) + camera) * pixels
                splat(images.exits, images, base + pixel, weight * value, t.lasers, rng, ~blocked)
        turn += 1
    return rng


def first_image(images: Images, tag: Any, surface_only: Any, count: int) -> Any:
    """Number of the first of a tag's `count` images of the layer that the light belongs to."""
    layer = dr.select(surface_only, mi.UInt32(1), mi.UInt32(0)) if images.layers == 2 else mi.UInt32(0)
    return (tag * images.layers + layer) * count


def meet_sky(
    t: Tables,
    sky: Sky | None,
    images: Images | None,
    tag: Any,
    towards: Any,
    weight: Any,
    surface_only: Any,
    rng: Rng,
    ok: Any,
) -> None:
    """What the sky radiates from the direction `towards` in which a walk from a pixel has left."""
    assert sky is not None and images is not None
    value = weight * sky.source.radiance(towards)
    splat(images.exits, images, first_image(images, tag, surface_only, 1), value, t.lasers, rng, ok)
