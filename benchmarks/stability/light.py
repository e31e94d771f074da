"""The photon walk: known answers where media are empty, black, white, dense, forward, contrasted, small and large."""

from __future__ import annotations

import math
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh

from benchmarks.stability.case import Family, relative
from benchmarks.stability.material import support
from disco_twin.object.build import Medium, TwinBoundary, TwinObject
from hw.base.arrays import F64
from pipeline.relight.lights import Uniform

FAMILY = Family("light")
SIGMA = 4.5  # standard errors
RUNS = 16


@cache
def twins() -> Any:
    """The tests' small objects and traces; starts the renderer."""
    from disco_twin.light.backend import activate

    activate()
    return support("twins")


def transport(obj: TwinObject, **options: Any) -> Any:
    twins()
    from disco_twin.light.transport import Transport

    return Transport(obj, cells=64, **options)


def case(name: str, expected: str, extent: str, tolerance: float, **more: Any) -> Any:
    return FAMILY.case(name, expected, extent, tolerance, slow=True, **more)


def errors(power: F64, exact: float, floor: float = 0.0) -> float:
    """Standard errors by which the mean of (R,) replicates is off; floor: a share of `exact` that is no error."""
    power = np.asarray(power, np.float64)
    spread = power.std(ddof=1) / math.sqrt(len(power))
    return float(max(abs(power.mean() - exact) - floor * exact, 0.0) / max(spread, 2e-6))


def half_space(
    kind: str, n: float, sigma_t: float, albedo: float, exact: float, width: float, floor: float = 0.0
) -> float:
    """Share of a normal beam that comes back from a block much thicker than it lets light through."""
    t = twins()
    own = transport(t.twin(t.block(width, width / 2), kind, n, sigma_t, [albedo]))
    power, traced = t.escaped(own, t.beam(RUNS, origin=(0.37 * width / 40, -0.21 * width / 40, width)), RUNS, 5000, 56)
    if abs(traced.balance.residual[0]) > 1e-5:
        return np.inf
    return errors(power[:, 0], exact, floor)


for sigma_t, width, floor in (
    (10.0, 80.0, 0.0),
    (1e3, 20.0, 0.0),
    (1e4, 2.0, 0.005),
    (1e4, 20.0, 0.02),
    (1e4, 160.0, 0.1),
):
    case(
        f"a half-space of {sigma_t:g} free paths a mm, {width:g} mm wide",
        "Chandrasekhar's: .752721 of albedo .99, within what is told of rounding",
        f"optical depth {sigma_t * width / 2:.0e}",
        SIGMA,
    )(partial(half_space, "matched", 1.0, sigma_t, 0.99, 0.752721, width, floor))
case(
    "a half-space of index 1.5",
    "Chandrasekhar's with Fresnel's boundary: .561981 of albedo .99",
    "optical depth 400",
    SIGMA,
)(partial(half_space, "smooth", 1.5, 10.0, 0.99, 0.561981, 80.0))


def through(kind: str, n: float, sigma_t: float, albedo: float, depth: float, exact: float) -> float:
    """Share of a normal beam that leaves a wide plate on the other side."""
    t = twins()
    own = transport(t.twin(t.block(40.0, depth), kind, n, sigma_t, [albedo]))
    traced = own.trace(t.beam(RUNS), RUNS, 8000, seed=57, deposit=True)
    if abs(traced.balance.residual[0]) > 1e-5:
        return np.inf
    power = traced.deposits[:, 0, own.vertices[:, 2] < -depth / 2].sum(axis=1)
    return errors(power, exact)


def clear_plate(n: float) -> float:
    r = ((n - 1) / (n + 1)) ** 2
    return (1 - r) / (1 + r)


for name, kind, n, sigma_t, albedo, depth, exact in (
    ("nothing inside", "matched", 1.0, 0.0, 0.9, 5.0, 1.0),
    ("next to nothing inside", "matched", 1.0, 1e-6, 0.9, 5.0, math.exp(-5e-7)),
    ("black, 10 free paths", "matched", 1.0, 10.0, 0.0, 1.0, math.exp(-10.0)),
    ("black, 100 free paths", "matched", 1.0, 100.0, 0.0, 1.0, 0.0),
    ("clear, index 1.5", "smooth", 1.5, 0.0, 0.9, 5.0, clear_plate(1.5)),
    ("clear, index 2.4", "smooth", 2.4, 1e-9, 0.9, 5.0, clear_plate(2.4)),
    ("clear, index 1.001", "smooth", 1.001, 0.0, 0.9, 5.0, clear_plate(1.001)),
):
    case(f"a plate: {name}", "what passes in closed form", f"optical depth {sigma_t * depth:g}, index {n:g}", SIGMA)(
        partial(through, kind, n, sigma_t, albedo, depth, exact)
    )


def layer(albedo: float, tau: float, cells: int = 400) -> tuple[float, float]:
    """Reflected and transmitted share of a normal beam on a layer with isotropic scattering: collocation."""
    from scipy.special import expn

    edge = np.linspace(0, tau, cells + 1)
    middle = (edge[1:] + edge[:-1]) / 2
    integral = np.sign(edge - middle[:, None]) * (1 - expn(2, np.abs(edge - middle[:, None])))
    first = -np.diff(np.exp(-edge)) / np.diff(edge)
    density = np.linalg.solve(np.eye(cells) - albedo * np.diff(integral, axis=1) / 2, first) * np.diff(edge)
    back, forth = (float(albedo * (density * expn(2, d)).sum() / 2) for d in (middle, tau - middle))
    return back, forth + math.exp(-tau)


def thin_plate(depth: float) -> float:
    return through("matched", 1.0, 10.0, 0.9, depth, layer(0.9, 10 * depth)[1])


for depth in (0.004, 0.1):
    case(f"a plate of {depth:g} mm, a cell is .7 mm", "the integral equation's", f"{depth / 0.7:.2g} of a cell", SIGMA)(
        partial(thin_plate, depth)
    )


def lost(kind: str, n: float, sigma_t: float, alpha: float, g: float = 0.0) -> float:
    """What a white object keeps: absorbed, inside, or unexplained; a share of what was launched."""
    t = twins()
    own = transport(t.twin(t.block(20.0, 5.0), kind, n, sigma_t, [1.0], g=g, alpha=alpha))
    b = own.trace(t.beam(), 1, 20_000, seed=53).balance
    return float(abs(b.absorbed[0]) + abs(b.inside[0]) + abs(b.residual[0]))


for kind, n, alpha, g in (
    ("matched", 1.0, 0.0, 0.0),
    ("rough", 1.3, 0.02, 0.0),
    ("rough", 1.3, 1.0, 0.0),
    ("rough", 2.4, 0.3, 0.0),
    ("rough", 1.3, 0.3, 0.99),
    ("rough", 1.3, 0.3, -0.99),
):
    case(
        f"a white block: {kind}, index {n:g}, alpha {alpha:g}, g {g:g}",
        "nothing is absorbed; at most one photon in 10,000 is lost",
        "albedo 1",
        1e-4,
    )(partial(lost, kind, n, 10.0, alpha, g))


def cosines_off(g: float) -> float:
    """Standard errors by which the first two moments of the phase function's samples are off."""
    twins()
    import drjit as dr
    import mitsuba as mi

    from disco_twin.light.sampling import Rng, henyey_greenstein

    count = 1 << 20
    rng = Rng.of(mi.UInt32(1), mi.UInt32(2), dr.arange(mi.UInt32, count))
    axis = dr.zeros(mi.Vector3f, count)
    axis.z = 1.0
    cosine = np.array(henyey_greenstein(rng, axis, dr.opaque(mi.Float, g)).z, np.float64)
    if not np.isfinite(cosine).all():
        return np.nan
    second = 1.5 * cosine**2 - 0.5
    return max(float(abs(x.mean() - e) / (x.std() / math.sqrt(count))) for x, e in ((cosine, g), (second, g * g)))


for g in (0.0, 1e-3, -0.99, 0.99, 0.999):
    case(
        f"directions of g {g:g}",
        "mean cosine g, mean second Legendre polynomial g^2",
        f"1 - |g| = {1 - abs(g):.0e}",
        SIGMA,
    )(partial(cosines_off, g))


def rare(chance: float, fine: bool = True) -> float:
    """Standard errors by which the number of collisions that happen with so small a chance is off."""
    twins()
    from benchmarks.stability.rare_collisions import LANES, ROUNDS, counted

    mean = chance * LANES * ROUNDS
    return abs(counted(chance, fine) - mean) / math.sqrt(mean)


for chance in (1e-6, 3e-8):
    case(
        f"contrast of {1 / chance:.0e}: a collision of that chance",
        "as often as it should, of 2^30 draws",
        f"chance {chance:.0e}",
        SIGMA,
        rivals={"uniform numbers of 23 bits": partial(rare, chance, False)},
    )(partial(rare, chance))


def contrasted(low: float, high: float, local: bool = True) -> float:
    """Standard errors of what passes the thin half of a plate of 2 mm, beside a half that is dense."""
    t = twins()
    mesh = t.block(8.0, 2.0)
    grid = np.full((1, 4, 16, 16), low, np.float32)
    grid[..., 12:] = high
    bounds = np.asarray(mesh.bounds, float)
    obj = TwinObject(
        mesh, TwinBoundary("matched", 1.0, 0.0), Medium(grid, np.zeros_like(grid), bounds[0], bounds[1], (0.0,))
    )
    own = transport(obj, local=local)
    traced = own.trace(t.beam(RUNS, origin=(-2.0, 0.3, 50.0)), RUNS, 2000, seed=8, deposit=True)
    return errors(traced.deposits[:, 0, own.vertices[:, 2] < -1.0].sum(axis=1), math.exp(-2 * low))


for low, high in ((0.5, 50.0), (1e-2, 1e4)):
    case(
        f"a thin half beside a dense one, contrast {high / low:.0e}",
        "what passes the thin half, exp(-tau)",
        f"{high / low:.0e}",
        SIGMA,
    )(partial(contrasted, low, high))


def of_size(size: float) -> float:
    """Standard errors between a ball of 20 mm and one of another size and the same optical depth."""
    powers = []
    for length in (20.0, size):
        t = twins()
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=length / 2)
        own = transport(t.twin(mesh, "rough", 1.3, 20.0 / length, [0.95]))
        origin = (0.11 * length, 0.07 * length, 3 * length)
        powers.append(t.escaped(own, t.beam(RUNS, origin=origin, radius=1e-4 * length), RUNS, 3000, 5)[0][:, 0])
    one, other = powers
    return float(abs(one.mean() - other.mean()) / math.sqrt((one.var(ddof=1) + other.var(ddof=1)) / RUNS))


for size in (1.0, 300.0):
    case(
        f"a ball of {size:g} mm", "as much leaves as of one of 20 mm and the same optical depth", f"{size:g} mm", SIGMA
    )(partial(of_size, size))


def furnace(depth: float, ours: bool = True) -> float:
    """Standard errors by which a white block in even light departs from it; by our walk, or by stock Mitsuba."""
    t = twins()
    obj = t.twin(t.block(40.0, 10.0), "matched", 1.0, depth / 10.0, [1.0])
    camera, light = t.camera((0.0, 1.0, 400.0), 6.0, 8), Uniform(colour=(1.0,))
    if ours:
        from disco_twin.light.rendering import from_pixels

        image = from_pixels(transport(obj), light, camera, 0.1, 1)(8, 1)
        return errors(image.mean(axis=0).sum(axis=0).ravel(), 1.0)
    import mitsuba as mi

    from benchmarks.volpath import volpath_scene

    with TemporaryDirectory() as folder:
        scene = volpath_scene(obj, camera, light, Path(folder))
        return errors(np.array(mi.render(scene, spp=16, seed=1)).ravel(), 1.0)


for depth in (10.0, 1e4):
    case(
        f"a white block in even light, optical depth {depth:g}",
        "as bright as the light around it",
        f"albedo 1, optical depth {depth:g}",
        SIGMA,
        rivals={"stock Mitsuba's volpath, 4000 bounces": partial(furnace, depth, False)},
    )(partial(furnace, depth))


def dark_image() -> float:
    """Pixels that are not finite, behind a black plate of 200 free paths."""
    t = twins()
    own = transport(t.twin(t.block(20.0, 10.0), "matched", 1.0, 20.0, [0.5]))
    view = t.camera((0.0, 10.0, -400.0), 30.0, 16)
    image = own.trace(t.beam(), 1, 5000, seed=3, cameras=[view]).images
    return float((~np.isfinite(image)).sum() + (image < 0).sum())


case("a camera behind 200 free paths", "finite, none below 0", "exp(-200) is none in single precision", 0.0)(dark_image)


def accumulated(walks: int) -> float:
    """Relative error of a pixel that holds so many walks of equal light, read out as an image is."""
    twins()
    import drjit as dr
    import mitsuba as mi

    from disco_twin.light.transport import new_images, read_images

    images = new_images(1, 1, 1.0)
    count = int(0.7310586 * float(images.inverse_quantum[0]))
    total = mi.UInt64(np.array([count * walks], np.uint64))
    dr.eval(total)
    images.exits = total
    return relative(read_images(images, (1, 1, 1), walks).ravel()[0], count / float(images.inverse_quantum[0]))


for walks in (10**6, 10**9):
    case(f"a pixel of {walks:.0e} walks", "the mean, to single precision", f"{walks:.0e} walks", 1e-6)(
        partial(accumulated, walks)
    )
