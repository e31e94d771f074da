"""The photon walk: one loop that launches, scatters, crosses the boundary and connects to the cameras.

Woodcock (null-collision) tracking through a heterogeneous medium inside a rough, smooth or index-matched boundary,
written for Dr.Jit's symbolic loops:

- *regeneration*: a lane whose photon has ended fetches the next one from a shared counter;
- *distance skip*: a flight that stays within two empty balls needs no intersection test (distance.py);
- *inner collisions*: up to `INNER` collisions per outer step, so that surface code does not run for one lane in
  sixteen;
- *one walk, all wavelengths*: wavelengths that share sigma_t and g differ in albedo alone, so one photon carries a
  weight for each;
- *lobe connection*: seen from inside, the directions that refract towards a camera fill a narrow lobe. Of the
  collisions of an outer step that lie near the surface one is drawn (reservoir) and sends an extra flight into a von
  Mises-Fisher lobe about that direction. Its contribution and that of ordinary exits are combined by the balance
  heuristic (Veach 1997, section 9.2.2). Across an index-matched boundary the connection is straight instead.

Images and deposits are accumulated as 64-bit integers of stochastically rounded weights: exact, independent of the
order of atomics, and so of batch size and thread count.

Not supported: emission, polarisation, an index that varies inside, wavelength change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from disco_twin.light import sampling
from disco_twin.light.sampling import Rng
from disco_twin.light.sources import Source, weight_type

INNER = 8  # collisions per outer step
FAR = 1e30
MAX_STEPS = 1 << 18  # outer steps after which a photon is counted as still inside


class Opaque:
    """Arrays that the walk reads or adds to. Not a dataclass: Dr.Jit would carry its fields through every loop."""

    def __init__(self, **fields: Any) -> None:
        if set(fields) != set(type(self).__annotations__):
            raise TypeError(f"{type(self).__name__} takes {sorted(type(self).__annotations__)}")
        self.__dict__.update(fields)


class Tables(Opaque):
    """What the walk reads; see transport.py for where it comes from. Floats are opaque so that kernels are reused."""

    scene: Any
    bsdf: Any
    lasers: int
    matched: bool
    eta: float
    homogeneous: bool
    isotropic: bool
    g: Any
    majorant: Any
    medium: Any  # Float, per voxel (sigma_t / majorant, albedo...), padded to 2 or 4 channels
    albedo: Any  # weight type, the homogeneous medium's
    dims: Any
    medium_low: Any
    medium_scale: Any
    distance: Any
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
    """Pinhole cameras of equal size as rows of ROW floats: position, right, down, forward, focal, centre, distortion."""

    count: int
    width: int
    height: int
    rows: Any


ROW = 21


def cell_index(t: Tables, q: Any) -> Any:
    """Flat index of the distance field's cell at q, clamped to the grid's rim."""
    cell = mi.Point3i(dr.floor((q - t.low) * t.inverse_cell))
    cell = dr.minimum(dr.maximum(cell, 0), t.cells - 1)
    return mi.UInt32((cell.z * t.cells + cell.y) * t.cells + cell.x)


def medium_at(t: Tables, q: Any, rng: Rng) -> tuple[Any, Any]:
    """Probability of a real collision and the albedo per wavelength at q.

    One voxel of the eight is drawn with its trilinear weight: sigma_t and sigma_s = albedo * sigma_t are then
    interpolated linearly in expectation, which is all that an unbiased walk needs, at one look-up instead of eight.
    """
    if t.homogeneous:
        return mi.Float(1.0), t.albedo
    grid = (q - t.medium_low) * t.medium_scale - 0.5
    voxel = mi.Point3i(dr.floor(grid + mi.Point3f(rng.next(), rng.next(), rng.next())))
    voxel = mi.Point3i(
        dr.clip(voxel.x, 0, t.dims.x - 1), dr.clip(voxel.y, 0, t.dims.y - 1), dr.clip(voxel.z, 0, t.dims.z - 1)
    )
    index = mi.UInt32((voxel.z * t.dims.y + voxel.y) * t.dims.x + voxel.x)
    if t.lasers == 1:
        value = dr.gather(mi.Vector2f, t.medium, index)
        return value[0], mi.Color1f(value[1])
    value = dr.gather(mi.Vector4f, t.medium, index)
    if t.lasers == 2:
        return value[0], mi.Vector2f(value[1], value[2])
    return value[0], mi.Color3f(value[1], value[2], value[3])


def refracted_axis(t: Tables, normal: Any, towards: Any) -> Any:
    """Inside direction that a smooth boundary refracts into `towards` (Snell), the lobe's axis."""
    tangent = (towards - normal * dr.dot(normal, towards)) * (1.0 / t.eta)
    return dr.normalize(tangent + normal * dr.safe_sqrt(1.0 - dr.squared_norm(tangent)))


def lobe_density(t: Tables, q: Any, direction: Any, target: Any) -> tuple[Any, Any, Any]:
    """Axis of the lobe at collision q towards `target`, its density at `direction`, and whether it is used there."""
    index = cell_index(t, q)
    normal = dr.gather(mi.Vector3f, t.normal, index)
    towards = dr.normalize(target - q)
    usable = (dr.dot(normal, towards) > -0.1) & (dr.squared_norm(normal) > 0.5)
    axis = refracted_axis(t, normal, towards)
    return axis, sampling.von_mises_fisher_pdf(dr.dot(axis, direction), t.kappa), usable


@dr.syntax  # type: ignore[untyped-decorator]
def transmittance(t: Tables, origin: Any, direction: Any, length: Any, rng: Rng) -> Any:
    """Unbiased transmittance along a segment inside the medium: exact, or by ratio tracking (Novak et al. 2014)."""
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
                real, _ = medium_at(t, dr.fma(direction, travelled, origin), rng)
                result *= 1.0 - real
    return result


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


class Images(Opaque):
    """Integer accumulators of the images: sums and sums of squares from exits and from lobe connections.

    Index ((tag * layers + layer) * cameras + camera) * lasers + laser) * pixels + pixel; layers are 1 (all light) or 2
    (light from below the surface, light reflected at it). One count is `quantum` (`quantum_squared`).
    """

    layers: int
    exits: Any
    exits_squared: Any
    lobes: Any
    lobes_squared: Any
    inverse_quantum: Any
    inverse_quantum_squared: Any


def splat(total: Any, squared: Any, images: Images, base: Any, stride: int, value: Any, lasers: int, rng: Rng, ok: Any) -> None:
    """Add a contribution per wavelength, stochastically rounded to whole quanta."""
    dither = rng.next()
    for k in range(lasers):
        v = dr.select(ok, value[k], 0.0)
        count = mi.UInt64(v * images.inverse_quantum + dither)
        square = mi.UInt64(v * v * images.inverse_quantum_squared + dither)
        dr.scatter_add(total, count, base + k * stride, ok)
        dr.scatter_add(squared, square, base + k * stride, ok)


@dr.syntax  # type: ignore[untyped-decorator]
def straight_transmittance(t: Tables, origin: Any, target: Any, rng: Rng) -> Any:
    """Transmittance from a collision straight to a camera through an index-matched boundary, cavities included."""
    direction = target - origin
    length = dr.norm(direction)
    direction = direction / length
    result = mi.Float(1.0)
    inside = mi.Bool(True)
    p = mi.Point3f(origin)
    going = mi.Bool(True)
    while dr.hint(going, label="straight"):
        hit = t.scene.ray_intersect(
            mi.Ray3f(p, direction, FAR, 0.0, mi.Color0f()), mi.RayFlags.Minimal, False, True
        )
        going = hit.is_valid()
        if dr.hint(going & inside):
            result *= transmittance(t, p, direction, hit.t, rng)
        going &= result > 0.0
        if dr.hint(going):
            outward = dr.dot(hit.n, direction) > 0.0
            inside = ~outward
            p = mi.Point3f(hit.p + hit.n * dr.select(outward, t.lift, -t.lift))
    return result


@dr.syntax  # type: ignore[untyped-decorator]
def connect_lobes(
    t: Tables, cams: Cameras, images: Images, tag: Any, point: Any, before: Any, weight: Any, rng: Rng
) -> None:
    """Connect one drawn collision to every camera. `before` is the flight's direction before the collision."""
    pixels = cams.width * cams.height
    context = mi.BSDFContext(mi.TransportMode.Importance)
    camera = mi.UInt32(0)
    while dr.hint(camera < cams.count, label="lobes"):
        base = (tag * (images.layers * cams.count) + camera) * (t.lasers * pixels)
        if dr.hint(t.matched, mode="scalar"):
            position, towards, pixel, factor, seen = project(cams, camera, point)
            if dr.hint(seen):
                through = straight_transmittance(t, point, position, rng)
                phase = sampling.henyey_greenstein_pdf(dr.dot(before, towards), t.g)
                splat(
                    images.lobes, images.lobes_squared, images, base + pixel, pixels,
                    weight * (phase * through * factor), t.lasers, rng, through > 0.0,
                )  # fmt: skip
        else:
            row = camera * ROW
            eye = mi.Point3f(*[dr.gather(mi.Float, cams.rows, row + k) for k in range(3)])
            axis, _, usable = lobe_density(t, point, before, eye)
            if dr.hint(usable):
                kappa = t.kappa
                omega = sampling.von_mises_fisher(rng, axis, kappa)
                lobe = sampling.von_mises_fisher_pdf(dr.dot(axis, omega), kappa)
                phase = sampling.henyey_greenstein_pdf(dr.dot(before, omega), t.g)
                hit = t.scene.ray_intersect(
                    mi.Ray3f(point, omega, t.length, 0.0, mi.Color0f()), mi.RayFlags.Minimal, False, True
                )
                if dr.hint(hit.is_valid()):
                    hit.sh_frame = mi.Frame3f(hit.n)
                    hit.wi = hit.to_local(-omega)
                    position, towards, pixel, factor, seen = project(cams, camera, hit.p)
                    seen &= (dr.dot(hit.n, towards) > 0.0) & (dr.dot(hit.n, omega) > 0.0)
                    if dr.hint(seen):
                        value = t.bsdf.eval(context, hit, hit.to_local(towards), True)[0]
                        value *= factor * phase / (phase + lobe)
                        if dr.hint(value > 0.0):
                            value *= transmittance(t, point, omega, hit.t, rng)
                            start = mi.Point3f(hit.p + hit.n * t.lift)
                            blocked = t.scene.ray_test(
                                mi.Ray3f(start, towards, FAR, 0.0, mi.Color0f()), False, True
                            )
                            splat(
                                images.lobes, images.lobes_squared, images, base + pixel, pixels,
                                weight * value, t.lasers, rng, ~blocked,
                            )  # fmt: skip
        camera += 1


@dr.syntax  # type: ignore[untyped-decorator]
def connect_exit(
    t: Tables, cams: Cameras, images: Images, tag: Any, si: Any, direction: Any, weight: Any,
    collision: Any, phase: Any, lobed: Any, surface_only: Any, rng: Rng,
) -> None:  # fmt: skip
    """Connect a photon that meets the surface to every camera through the boundary's BSDF.

    collision, phase, lobed: the flight's last collision, the phase density of its direction and whether a lobe
    connection could have made the same path (then the balance heuristic shares it).
    """
    pixels = cams.width * cams.height
    context = mi.BSDFContext(mi.TransportMode.Importance)
    camera = mi.UInt32(0)
    while dr.hint(camera < cams.count, label="exits"):
        position, towards, pixel, factor, seen = project(cams, camera, si.p)
        seen &= dr.dot(si.n, towards) > 0.0
        if dr.hint(seen):
            value = t.bsdf.eval(context, si, si.to_local(towards), True)[0] * factor
            _, lobe, usable = lobe_density(t, collision, direction, position)
            value *= dr.select(lobed & usable, phase / (phase + lobe), 1.0)
            if dr.hint(value > 0.0):
                start = mi.Point3f(si.p + si.n * t.lift)
                blocked = t.scene.ray_test(mi.Ray3f(start, towards, FAR, 0.0, mi.Color0f()), False, True)
                layer = mi.UInt32(0)
                if dr.hint(images.layers == 2, mode="scalar"):
                    layer = dr.select(surface_only, mi.UInt32(1), mi.UInt32(0))
                base = ((tag * images.layers + layer) * cams.count + camera) * (t.lasers * pixels) + pixel
                splat(
                    images.exits, images.exits_squared, images, base, pixels, weight * value, t.lasers, rng, ~blocked
                )
        camera += 1


class Deposits(Opaque):
    """Integer accumulators of the power that leaves through the surface, shared among each triangle's vertices.

    Index (tag * lasers + laser) * vertices + vertex; one count is `scale` = `1 / inverse_quantum` watts.
    """

    total: Any
    inverse_quantum: Any
    scale: float


def deposit(t: Tables, deposits: Deposits, tag: Any, si: Any, weight: Any, rng: Rng, ok: Any) -> None:
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
class Balance:
    """Where the launched power went, per lane and wavelength: sums over the photons that the lane walked."""

    launched: Any
    reflected: Any  # left without ever having entered
    escaped: Any  # left after having entered
    absorbed: Any
    boundary: Any  # lost by the single-scatter rough boundary
    roulette: Any  # created (or destroyed) by Russian roulette; zero in the mean
    inside: Any  # still inside when a photon was cut off, or leaked through a mesh that is not watertight


@dr.syntax  # type: ignore[untyped-decorator]
def walk(
    t: Tables, source: Source, cams: Cameras | None, images: Images | None, deposits: Deposits | None,
    count: Any, per_tag: Any, first: Any, first_tag: Any, streams: Any, seed: Any, lanes: int,
) -> Balance:  # fmt: skip
    """Walk `count` photons, `per_tag` of each tag, numbers `first`... of their tag's stream; returns the balance.

    Tags start at `first_tag` for the source and the streams, at 0 in the accumulators. streams: UInt32 per tag, the
    name of its random stream; results depend on (seed, stream, photon number) alone.
    """
    weight = weight_type(t.lasers)
    counter = dr.zeros(mi.UInt32, 1)
    dr.eval(counter)
    wide = dr.float64_array_t(weight)
    zero_w = dr.zeros(weight, lanes)
    # Double precision: regeneration may send every photon through a few lanes.
    sums = Balance(*[wide(zero_w) for _ in range(7)])
    rng = Rng(dr.zeros(mi.UInt32, lanes), dr.zeros(mi.UInt32, lanes))
    p, d, w = dr.zeros(mi.Point3f, lanes), dr.zeros(mi.Vector3f, lanes), weight(zero_w)
    clear = dr.zeros(mi.Vector3f, lanes)  # lifts the origin of the next intersection test off the surface just left
    empty, flight = dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes)  # empty ball at p; length of the flight
    tag, steps = dr.zeros(mi.UInt32, lanes), dr.zeros(mi.UInt32, lanes)
    inside, entered, alive = dr.zeros(mi.Bool, lanes), dr.zeros(mi.Bool, lanes), dr.zeros(mi.Bool, lanes)
    running = dr.full(mi.Bool, True, lanes)
    # The last collision, for the balance heuristic: place, whether in reach of the surface, phase density of the flight.
    last, in_reach, phase = dr.zeros(mi.Point3f, lanes), dr.zeros(mi.Bool, lanes), dr.zeros(mi.Float, lanes)
    # The reservoir: how many collisions it has seen, and the drawn one with the flight before it and its weight.
    seen, drawn, before, drawn_w = dr.zeros(mi.Float, lanes), dr.zeros(mi.Point3f, lanes), dr.zeros(mi.Vector3f, lanes), weight(zero_w)
    d.z = -1.0

    while dr.hint(running, label="walk"):
        # 1. A lane without a photon fetches the next one.
        need = running & ~alive
        if dr.hint(need):
            index = dr.scatter_inc(counter, mi.UInt32(0), need)
            running = index < count
            tag = dr.minimum(index, count - 1) // per_tag
            rng = Rng.of(seed, dr.gather(mi.UInt32, streams, first_tag + tag), first + (index - tag * per_tag))
            p, d, w = source.launch(rng, first_tag + tag, running)
            sums.launched += wide(dr.select(running, w, 0.0))
            alive = running & (dr.max(w) > 0.0)
            inside = mi.Bool(False)
            entered = mi.Bool(False)
            in_reach = mi.Bool(False)
            clear = mi.Vector3f(0.0)
            steps = mi.UInt32(0)

        # 2. Collisions that need no intersection test.
        k = mi.UInt32(0)
        pending = alive & ~inside
        while dr.hint((k < INNER) & alive & ~pending, label="collisions"):
            k += 1
            flight = sampling.exponential(rng) / t.majorant
            q = mi.Point3f(dr.fma(d, flight, p))
            ball = dr.gather(mi.Float, t.distance, cell_index(t, q))
            pending = flight >= empty + ball
            if dr.hint(~pending):
                p = mi.Point3f(q)
                clear = mi.Vector3f(0.0)
                empty = ball
                chance, albedo = medium_at(t, q, rng)
                if dr.hint(rng.next() < chance):
                    sums.absorbed += wide(w * (1.0 - albedo))
                    w *= albedo
                    near = mi.Bool(True)
                    if dr.hint(not t.matched, mode="scalar"):
                        near = ball < t.reach
                    if dr.hint(cams is not None, mode="scalar"):
                        seen = dr.select(near, seen + 1.0, seen)
                        take = near & (rng.next() * seen < 1.0)
                        drawn = dr.select(take, p, drawn)
                        before = dr.select(take, d, before)
                        drawn_w = dr.select(take, w, drawn_w)
                    scattered = sampling.uniform_sphere(rng)
                    phase = mi.Float(1.0 / (4.0 * math.pi))
                    if dr.hint(not t.isotropic, mode="scalar"):
                        scattered = sampling.henyey_greenstein(rng, d, t.g)
                        phase = sampling.henyey_greenstein_pdf(dr.dot(d, scattered), t.g)
                    d = mi.Vector3f(scattered)
                    last = mi.Point3f(p)
                    in_reach = near

        # 3. One drawn collision connects to the cameras.
        if dr.hint(cams is not None, mode="scalar"):
            if dr.hint(seen > 0.0):
                connect_lobes(t, cams, images, tag, drawn, before, drawn_w * seen, rng)
                seen = mi.Float(0.0)

        # 4. Russian roulette on the largest weight, towards 0.2.
        strongest = dr.max(w)
        if dr.hint(alive & inside & (strongest < 0.1)):
            chance = strongest * 5.0
            survives = rng.next() < chance
            after = dr.select(survives, w / chance, 0.0)
            sums.roulette += wide(after - w)
            w = after
            alive &= survives

        # 5. The surface, or a collision that the distance field could not vouch for.
        if dr.hint(alive & pending):
            steps += 1
            reach = dr.select(inside, flight, FAR)
            ray = mi.Ray3f(mi.Point3f(p + clear), d, reach, 0.0, mi.Color0f())
            si = t.scene.ray_intersect(ray, mi.RayFlags.Minimal, False, True)
            clear = mi.Vector3f(0.0)
            # Measured from p itself: the lifted origin is nearer to the far wall, which matters in thin plates.
            if dr.hint(si.is_valid() & (~inside | (dr.dot(si.p - p, d) < flight))):
                outward = dr.dot(si.n, d) > 0.0
                if dr.hint(t.matched, mode="scalar"):
                    leaves = mi.Bool(outward)
                    if dr.hint(deposits is not None, mode="scalar"):
                        deposit(t, deposits, tag, si, w, rng, leaves)
                    p = mi.Point3f(si.p)
                    clear = mi.Vector3f(si.n * dr.select(leaves, t.lift, -t.lift))
                    inside = ~leaves
                    entered |= inside
                else:
                    si.sh_frame = mi.Frame3f(si.n)
                    si.wi = si.to_local(-d)
                    if dr.hint(cams is not None, mode="scalar"):
                        lobed = inside & in_reach & (dr.norm(si.p - last) < t.length)
                        connect_exit(t, cams, images, tag, si, d, w, last, phase, lobed, ~entered, rng)
                    context = mi.BSDFContext(mi.TransportMode.Importance)
                    sample, value = t.bsdf.sample(context, si, rng.next(), rng.next2(), True)
                    after = w * value[0]
                    sums.boundary += wide(w - after)
                    w = after
                    was_inside = mi.Bool(inside)
                    inside = sample.wo.z < 0.0
                    alive = dr.max(w) > 0.0
                    if dr.hint(deposits is not None, mode="scalar"):
                        deposit(t, deposits, tag, si, w, rng, was_inside & ~inside & alive)
                    d = mi.Vector3f(si.to_world(sample.wo))
                    p = mi.Point3f(si.p)
                    clear = mi.Vector3f(si.n * dr.select(inside, -t.lift, t.lift))
                    entered |= inside
                    in_reach = mi.Bool(False)
                empty = mi.Float(0.0)
            else:
                if dr.hint(inside):
                    p = mi.Point3f(dr.fma(d, flight, p))
                    leaked = dr.max(dr.abs(p)) > t.bound
                    sums.inside += wide(dr.select(leaked, w, 0.0))
                    alive = ~leaked
                    empty = dr.gather(mi.Float, t.distance, cell_index(t, p))
                    chance, albedo = medium_at(t, p, rng)
                    if dr.hint(alive & (rng.next() < chance)):
                        sums.absorbed += wide(w * (1.0 - albedo))
                        w *= albedo
                        near = mi.Bool(True)
                        if dr.hint(not t.matched, mode="scalar"):
                            near = empty < t.reach
                        if dr.hint(cams is not None, mode="scalar"):
                            seen = dr.select(near, 1.0, 0.0)
                            drawn = mi.Point3f(p)
                            before = mi.Vector3f(d)
                            drawn_w = weight(w)
                        scattered = sampling.uniform_sphere(rng)
                        phase = mi.Float(1.0 / (4.0 * math.pi))
                        if dr.hint(not t.isotropic, mode="scalar"):
                            scattered = sampling.henyey_greenstein(rng, d, t.g)
                            phase = sampling.henyey_greenstein_pdf(dr.dot(d, scattered), t.g)
                        d = mi.Vector3f(scattered)
                        last = mi.Point3f(p)
                        in_reach = near
                else:
                    sums.reflected += wide(dr.select(entered, 0.0, w))
                    sums.escaped += wide(dr.select(entered, w, 0.0))
                    alive = mi.Bool(False)
            cut = alive & (steps > MAX_STEPS)
            sums.inside += wide(dr.select(cut, w, 0.0))
            alive &= ~cut
    return sums
