"""The photon walk: one loop that launches, scatters, crosses the boundary and connects to the cameras.

Woodcock (null-collision) tracking through a heterogeneous medium inside a rough, smooth or index-matched boundary,
written for Dr.Jit's symbolic loops:

- *regeneration*: a lane whose photon has ended fetches the next one from a shared counter;
- *distance skip*: a flight that stays within two empty balls needs no intersection test (distance.py);
- *inner collisions*: up to `INNER` collisions per outer step, so that surface code does not run for one lane in
  sixteen;
- *weight windows*: Russian roulette, and with a map splitting within the photon's history (splitting.py);
- *one walk, all wavelengths*: wavelengths that share sigma_t and g differ in albedo alone, so one photon carries a
  weight for each;
- *lobe connection*: of the collisions of an outer step that lie near the surface one is drawn (reservoir) and connects
  to the cameras; exits do so too (connect.py);
- *bodies inside*: cavities and inclusions with walls of their own, among which a photon knows its region (walls.py);
- *both ways*: a walk may start at a camera's pixel and meet a sky where it leaves. Paths are reciprocal: the share of
  the sky's radiance that it carries out is what comes back to the pixel, for power and importance cross the boundary by
  the same factors, whose eta^2 cancel from air to air (Veach 1997, section 5.2).

Images and deposits are accumulated as 64-bit integers of stochastically rounded weights: exact, independent of the
order of atomics, and so of batch size and thread count.

Not supported: emission, polarisation, an index that varies within a body, wavelength change.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from disco_twin.light import sampling
from disco_twin.light.connect import connect_exit, connect_lobes, lobes_of, meet_sky
from disco_twin.light.sampling import Rng
from disco_twin.light.sources import Source, weight_type
from disco_twin.light.splitting import Window, counted, new_stack, resume, weigh
from disco_twin.light.tables import (
    FAR,
    Cameras,
    Deposits,
    Images,
    Sky,
    Tables,
    boundary_context,
    free_flight,
    medium_at,
    near_surface,
    surroundings,
)
from disco_twin.light.walls import is_outer, medium_in, region_of, scatters
from disco_twin.object.bodies import OBJECT

INNER = 8  # collisions per outer step
MAX_STEPS = 1 << 18  # intersection tests after which a photon, or a copy of one, is cut off: its power is `inside`


def deposit(t: Tables, deposits: Any, tag: Any, si: Any, weight: Any, rng: Rng, ok: Any) -> None:
    """Share a photon's power among the hat functions of the vertices around its exit point."""
    index = [dr.gather(mi.UInt32, t.faces, 3 * si.prim_index + k, ok) for k in range(3)]
    a, b, c = (dr.gather(mi.Point3f, t.vertices, i, ok) for i in index)
    normal = dr.cross(b - a, c - a)
    inverse = 1.0 / dr.squared_norm(normal)
    b2 = dr.dot(dr.cross(b - a, si.p - a), normal) * inverse
    b1 = dr.dot(dr.cross(si.p - a, c - a), normal) * inverse
    dither = rng.next()
    for i, share in zip(index, (1.0 - b1 - b2, b1, b2), strict=True):
        for k in range(t.lasers):
            count = mi.UInt64(weight[k] * dr.clip(share, 0.0, 1.0) * deposits.inverse_quantum + dither)
            dr.scatter_add(deposits.total, count, (tag * t.lasers + k) * t.vertex_count + i, ok)


@dataclass
class Tally:
    """Where the launched power went, per lane and wavelength: sums over the photons that the lane walked."""

    launched: Any
    reflected: Any  # left without ever having entered
    escaped: Any  # left after having entered
    absorbed: Any
    boundary: Any  # lost by the single-scatter rough boundary
    roulette: Any  # created (or destroyed) by Russian roulette; zero in the mean
    inside: Any  # still inside when cut off after MAX_STEPS, or leaked through a mesh that is not watertight


@dataclass
class Photon:
    """One photon in flight, a lane of the wavefront."""

    p: Any  # where it is, mm
    d: Any  # where it flies
    w: Any  # power per wavelength
    tag: Any
    steps: Any  # intersection tests so far
    inside: Any  # in a medium now
    entered: Any  # has ever been
    alive: Any
    empty: Any  # radius of a ball about p that holds no surface
    rate: Any  # majorant at p, 1/mm
    clear: Any  # lifts the origin of the next intersection test off the surface just left
    # The last collision, for the balance heuristic: place, lobe connections that it sends, phase density of the flight.
    last: Any
    lobes: Any  # in the mean, to one camera
    phase: Any  # 0 before the first collision
    region: Any  # number of the region that it flies in; None where no bodies are inside


@dataclass
class Reservoir:
    """One collision drawn from those of an outer step: how many lobe connections all send in the mean, one of them if
    any unless connections are even; place, flight before it, power after it, connections of its own, asymmetry there
    (None where it is one for all).
    """

    seen: Any
    point: Any
    before: Any
    weight: Any
    lobes: Any
    g: Any


def no_photons(t: Tables, weight: Any, lanes: int) -> tuple[Photon, Reservoir]:
    """Lanes without a photon."""
    vector, number, flag = dr.zeros(mi.Vector3f, lanes), dr.zeros(mi.Float, lanes), dr.zeros(mi.Bool, lanes)
    point, power, integer = dr.zeros(mi.Point3f, lanes), dr.zeros(weight, lanes), dr.zeros(mi.UInt32, lanes)
    down = mi.Vector3f(vector)
    down.z = -1.0
    photon = Photon(
        mi.Point3f(point), down, weight(power), mi.UInt32(integer), mi.UInt32(integer), mi.Bool(flag), mi.Bool(flag),
        mi.Bool(flag), mi.Float(number), mi.Float(number + 1.0), mi.Vector3f(vector), mi.Point3f(point),
        mi.Float(number), mi.Float(number), None if t.walls is None else mi.UInt32(integer),
    )  # fmt: skip
    g = None if t.g_voxels is None else mi.Float(number)
    drawn = Reservoir(mi.Float(number), mi.Point3f(point), mi.Vector3f(vector), weight(power), mi.Float(number), g)
    return photon, drawn


@dr.syntax
def collide(
    t: Tables, photon: Photon, rate: Any, reservoir: Reservoir, sums: Tally, rng: Rng,
    cams: Cameras | None, window: Window | None, first_tag: Any,
) -> Any:  # fmt: skip
    """A possible collision at the photon's place, after a flight under the majorant `rate`: absorb, offer it to the
    reservoir, scatter; or nothing (null).

    Returns (photon, reservoir, sums, rng): Dr.Jit's branches replace the objects that they change.
    """
    chance, albedo, g = medium_at(t, photon.p, rng)
    sigma_t = chance * t.majorant
    if dr.hint(t.walls is not None, mode="scalar"):
        sigma_t, albedo, g = medium_in(t.walls, photon.region, sigma_t, albedo, g)
    if dr.hint(rng.fine() * rate < sigma_t):
        sums.absorbed += type(sums.absorbed)(photon.w * (1.0 - albedo))
        photon.w *= albedo
        near = near_surface(t, photon.empty)
        if dr.hint(t.walls is not None, mode="scalar"):
            near &= photon.region == OBJECT
        lobes = dr.select(near, 1.0, mi.Float(0.0))
        if dr.hint(cams is not None, mode="scalar"):
            if dr.hint(t.even, mode="scalar"):
                assert cams is not None
                if dr.hint(near):
                    lobes = lobes_of(t, cams, photon.p, photon.d, g, photon.empty)
            chance = lobes * counted(window, first_tag + photon.tag, photon.p)
            reservoir.seen += chance
            take = near & (rng.next() * reservoir.seen < chance)
            reservoir.point = dr.select(take, photon.p, reservoir.point)
            reservoir.before = dr.select(take, photon.d, reservoir.before)
            power = photon.w / lobes if t.even and t.matched else photon.w
            reservoir.weight = dr.select(take, power, reservoir.weight)
            reservoir.lobes = dr.select(take, lobes, reservoir.lobes)
            if dr.hint(t.g_voxels is not None, mode="scalar"):
                reservoir.g = dr.select(take, g, reservoir.g)
        scattered = sampling.uniform_sphere(rng)
        photon.phase = mi.Float(sampling.UNIFORM)
        if dr.hint(not t.isotropic, mode="scalar"):
            scattered = sampling.henyey_greenstein(rng, photon.d, g)
            photon.phase = sampling.henyey_greenstein_pdf(dr.dot(photon.d, scattered), g)
        photon.d = mi.Vector3f(scattered)
        photon.last = mi.Point3f(photon.p)
        photon.lobes = mi.Float(lobes)
    return photon, reservoir, sums, rng


@dr.syntax
def cross(
    t: Tables, photon: Photon, si: Any, cams: Cameras | None, images: Images | None, deposits: Deposits | None,
    sums: Tally, rng: Rng, window: Window | None, first_tag: Any,
) -> Any:  # fmt: skip
    """The photon meets the surface at si: connects to the cameras, is reflected or refracted, or leaves.

    Returns (photon, sums, rng).
    """
    if dr.hint(t.matched and t.walls is None, mode="scalar"):
        leaves = dr.dot(si.n, photon.d) > 0.0
        if dr.hint(deposits is not None, mode="scalar"):
            deposit(t, deposits, photon.tag, si, photon.w, rng, leaves)
        photon.inside = ~leaves
    else:
        si.sh_frame = mi.Frame3f(si.n)
        si.wi = si.to_local(-photon.d)
        outer = is_outer(t.walls, si)
        bsdf = t.bsdf if t.walls is None else si.shape.bsdf()
        if dr.hint(cams is not None, mode="scalar"):
            lobed = photon.inside & (photon.lobes > 0.0) & (dr.norm(si.p - photon.last) < t.length)
            weight = photon.w * counted(window, first_tag + photon.tag, dr.select(lobed, photon.last, si.p))
            if dr.hint(t.walls is not None, mode="scalar"):
                weight = dr.select(outer, weight, 0.0)
            rng = connect_exit(
                t, cams, images, photon.tag, si, photon.d, weight, photon.last, photon.phase,
                dr.select(lobed, photon.lobes, 0.0), ~photon.entered, rng,
            )  # fmt: skip
        sample, value = bsdf.sample(boundary_context(t), si, rng.next(), rng.next2(), True)
        after = photon.w * value[0]
        sums.boundary += type(sums.boundary)(photon.w - after)
        photon.w = after
        photon.alive = dr.max(after) > 0.0
        goes_in = sample.wo.z < 0.0
        if dr.hint(deposits is not None, mode="scalar"):
            deposit(t, deposits, photon.tag, si, after, rng, outer & photon.inside & ~goes_in & photon.alive)
        photon.d = mi.Vector3f(si.to_world(sample.wo))
        photon.inside = mi.Bool(goes_in)
    goes_in = mi.Bool(photon.inside)
    photon.entered |= goes_in
    if dr.hint(t.walls is not None, mode="scalar"):
        within = region_of(t.walls, si)
        photon.region = dr.select(goes_in, within, dr.gather(mi.UInt32, t.walls.around, within))
        photon.inside = scatters(t.walls, photon.region)
    photon.lobes = mi.Float(0.0)
    photon.p = mi.Point3f(si.p)
    photon.clear = mi.Vector3f(si.n * dr.select(goes_in, -t.lift, t.lift))
    _, photon.rate = surroundings(t, photon.p, photon.region)
    photon.empty = mi.Float(0.0)
    return photon, sums, rng


@dr.syntax
def fly(
    t: Tables, photon: Photon, flight: Any, rate: Any, reservoir: Reservoir, cams: Cameras | None,
    sky: Sky | None, images: Images | None, deposits: Deposits | None, sums: Tally, rng: Rng, window: Window | None,
    first_tag: Any,
) -> Any:  # fmt: skip
    """A flight that may meet the surface: up to it, to the collision at its end, or out of sight.

    Returns (photon, reservoir, sums, rng).
    """
    wide = type(sums.inside)
    photon.steps += 1
    reach = dr.select(photon.inside, flight, FAR)
    ray = mi.Ray3f(mi.Point3f(photon.p + photon.clear), photon.d, reach, 0.0, mi.Color0f())
    si = t.scene.ray_intersect(ray, mi.RayFlags.Minimal, False, True)
    photon.clear = mi.Vector3f(0.0)
    # Measured from p itself: the lifted origin is nearer to the far wall, which matters in thin plates.
    if dr.hint(si.is_valid() & (~photon.inside | (dr.dot(si.p - photon.p, photon.d) < flight))):
        photon, sums, rng = cross(t, photon, si, cams, images, deposits, sums, rng, window, first_tag)
    else:
        if dr.hint(photon.inside):
            photon.p = mi.Point3f(dr.fma(photon.d, flight, photon.p))
            photon.empty, photon.rate = surroundings(t, photon.p, photon.region)
            leaked = dr.max(dr.abs(photon.p)) > t.bound  # only through a mesh that is not watertight
            sums.inside += wide(dr.select(leaked, photon.w, 0.0))
            photon.alive = ~leaked
            if dr.hint(~leaked):
                photon, reservoir, sums, rng = collide(t, photon, rate, reservoir, sums, rng, cams, window, first_tag)
        else:
            if dr.hint(sky is not None, mode="scalar"):
                # Not of a walk that has met nothing: what lies behind the object is no part of its image.
                met = photon.phase > 0.0 if t.matched else photon.steps > 1
                meet_sky(t, sky, images, photon.tag, photon.d, photon.w, ~photon.entered, rng, met)
            left = mi.Bool(True)
            if dr.hint(t.walls is not None, mode="scalar"):
                left = photon.region == 0  # else out of a clear body whose mesh is not watertight
                sums.inside += wide(dr.select(left, 0.0, photon.w))
            sums.reflected += wide(dr.select(left & ~photon.entered, photon.w, 0.0))
            sums.escaped += wide(dr.select(left & photon.entered, photon.w, 0.0))
            photon.alive = mi.Bool(False)
    within = photon.inside if t.walls is None else photon.region != 0
    cut = photon.alive & within & (photon.steps > MAX_STEPS)  # outside it has been counted by the deposits
    sums.inside += wide(dr.select(cut, photon.w, 0.0))
    photon.alive &= ~cut
    return photon, reservoir, sums, rng


@dr.syntax
def walk(
    t: Tables, source: Source, cams: Cameras | None, sky: Sky | None, images: Images | None, deposits: Deposits | None,
    count: Any, per_tag: Any, first: Any, first_tag: Any, streams: Any, seed: Any, inverse_scale: Any,
    window: Window | None, lanes: int,
) -> Tally:  # fmt: skip
    """Walk `count` photons, `per_tag` of each tag, numbers `first`... of their tag's stream; returns the balance.

    Tags start at `first_tag` for the source and the streams, at 0 in the accumulators. streams: UInt32 per tag, the
    name of its random stream; results depend on (seed, stream, photon number) alone. inverse_scale: 1 / the source's
    usual weight.
    """
    weight = weight_type(t.lasers)
    wide = dr.float64_array_t(weight)  # sums in double precision: a few lanes may walk most of the photons
    sums = Tally(*[dr.zeros(wide, lanes) for _ in range(7)])
    counter = dr.zeros(mi.UInt32, 1)
    dr.eval(counter)
    rng = Rng(dr.zeros(mi.UInt32, lanes), dr.zeros(mi.UInt32, lanes))
    photon, reservoir = no_photons(t, weight, lanes)
    flight, rate = dr.zeros(mi.Float, lanes), dr.ones(mi.Float, lanes)
    running = dr.full(mi.Bool, True, lanes)
    stack = new_stack(t, cams is not None, lanes) if window is not None and window.splits else None

    while dr.hint(running, label="walk"):
        # 1. A lane without a photon takes a copy that waits, or fetches the next one.
        if dr.hint(stack is not None, mode="scalar"):
            photon, stack = resume(t, stack, photon, running, weight, cams is not None)
        need = running & ~photon.alive
        if dr.hint(need):
            index = dr.scatter_inc(counter, mi.UInt32(0), need)
            running = index < count
            tag = dr.minimum(index, count - 1) // per_tag
            rng = Rng.of(seed, dr.gather(mi.UInt32, streams, first_tag + tag), first + (index - tag * per_tag))
            photon.p, photon.d, photon.w = source.launch(rng, first_tag + tag, running)
            sums.launched += wide(dr.select(running, photon.w, 0.0))
            photon.alive = running & (dr.max(photon.w) > 0.0)
            photon.tag, photon.steps, photon.clear = tag, mi.UInt32(0), mi.Vector3f(0.0)
            photon.inside, photon.entered = mi.Bool(False), mi.Bool(False)
            photon.lobes, photon.phase = mi.Float(0.0), mi.Float(0.0)
            if dr.hint(t.walls is not None, mode="scalar"):
                photon.region = mi.UInt32(0)

        # 2. Collisions that need no intersection test.
        k = mi.UInt32(0)
        pending = photon.alive & ~photon.inside
        while dr.hint((k < INNER) & photon.alive & ~pending, label="collisions"):
            k += 1
            flight, rate = free_flight(t, photon.d, photon.rate, rng)
            q = mi.Point3f(dr.fma(photon.d, flight, photon.p))
            ball, there = surroundings(t, q, photon.region)
            pending = flight >= photon.empty + ball
            if dr.hint(~pending):
                # Copies: two names of one object would be merged as one when Dr.Jit joins the branches.
                photon.p, photon.empty, photon.rate = mi.Point3f(q), mi.Float(ball), mi.Float(there)
                photon.clear = mi.Vector3f(0.0)
                photon, reservoir, sums, rng = collide(t, photon, rate, reservoir, sums, rng, cams, window, first_tag)

        # 3. The surface, or a collision that the distance field could not vouch for.
        if dr.hint(photon.alive & pending):
            photon, reservoir, sums, rng = fly(
                t, photon, flight, rate, reservoir, cams, sky, images, deposits, sums, rng, window, first_tag
            )

        # 4. One drawn collision connects to the cameras, also of a photon that has just left.
        if dr.hint(cams is not None, mode="scalar"):
            if dr.hint(t.even, mode="scalar"):
                times = dr.floor(reservoir.seen + rng.next())
                while dr.hint(times > 0.0, label="connections"):
                    rng = connect_lobes(
                        t, cams, images, photon.tag, reservoir.point, reservoir.before, reservoir.weight,
                        t.g if t.g_voxels is None else reservoir.g, reservoir.lobes, rng,
                    )  # fmt: skip
                    times -= 1.0
                reservoir.seen = mi.Float(0.0)
            elif dr.hint(reservoir.seen > 0.0):
                drawn = reservoir.weight * reservoir.seen
                rng = connect_lobes(
                    t, cams, images, photon.tag, reservoir.point, reservoir.before, drawn,
                    t.g if t.g_voxels is None else reservoir.g, 1.0, rng,
                )  # fmt: skip
                reservoir.seen = mi.Float(0.0)

        # 5. The weight window: Russian roulette, splitting.
        photon, stack, sums, rng = weigh(
            t, window, stack, photon, first_tag, inverse_scale, sums, rng, cams is not None
        )
    return sums
