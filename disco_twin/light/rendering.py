"""Reference images: the object under other light, traced through the same medium, to a stated noise.

Which way a light is walked is a matter of its noise at equal time (docs/decisions/0054). A light from all around is met
by every walk that leaves: walks start at the camera's pixels. All others are walked from the light, for one camera at a
time, with even connections to it and weight windows that lead to what it sees.

How many walks there are is decided by pilot runs with random numbers of their own, which are thrown away: the images'
own values have no part in it, so stopping biases nothing.
"""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from disco_twin.light.importance import Views
from disco_twin.light.pixels import PixelSource, candidate_pixels
from disco_twin.light.references import HALVES, LAYERS, noise_of
from disco_twin.light.sampling import Rng
from disco_twin.light.sources import light_source, sky_source
from disco_twin.light.transport import Transport
from hw.base.arrays import F32, F64
from pipeline.geometry.camera import PinholeCamera
from pipeline.relight.lights import Environment, Light, Uniform

log = logging.getLogger(__name__)

FIRST_PILOT = {"light": 1 << 14, "pixel": 4}  # walks a half, of a light or of a pixel
PILOT_ENDS = 5.0  # times the noise that is asked for: a pilot costs a twentieth of the image
MARGIN = 1.15  # walks beyond what the last pilot asks for: its own noise is known to some per cent only
MOST_WALKS = {"light": 1 << 27, "pixel": 1 << 14}  # a half
BLACK_AFTER = {"light": 1 << 20, "pixel": 64}  # walks a half that have to find nothing before an image counts as black
SHINE_RUN = 31  # number of the run that looks from the pixels at what the surface reflects: no pilot gets there
SHINE = 0.5  # variance of a walk that the surface reflects, beside its mean squared, roughly
ENTRIES = 4096  # photons that tell where a light enters

Sky = Uniform | Environment
Render = Callable[[int, int], F32]  # (walks a half, number of the run) -> (2, 2, L, H, W)


def render_reference(
    transport: Transport, light: Light, cameras: Sequence[PinholeCamera], noise: float, seed: int
) -> list[F32]:
    """(2, 2, L, H, W) halves of one light's image for each camera, with at most about `noise` (see `noise_of`) over
    each. Both halves are made of the same number of walks.
    """
    renders = [
        from_pixels(transport, light, camera, noise, seed + k)
        if isinstance(light, Sky)
        else from_light(transport, light, camera, seed + k)
        for k, camera in enumerate(cameras)
    ]
    return [_to_noise(render, noise, "pixel" if isinstance(light, Sky) else "light") for render in renders]


def _to_noise(render: Render, noise: float, start: str) -> F32:
    """The image with the noise asked for."""
    walks = FIRST_PILOT[start]
    for run in itertools.count(1):
        found = _pilot_noise(render(walks, run), walks >= BLACK_AFTER[start])
        needed = walks * (found / noise) ** 2 * MARGIN
        if found <= PILOT_ENDS * noise or 4 * walks > MOST_WALKS[start]:
            break
        walks *= 4
    image = render(int(min(max(needed, 1), MOST_WALKS[start])), 0)
    kept = noise_of(image)
    if kept > MARGIN * noise:
        log.warning("a reference keeps %.0f %% noise, of which %.0f %% were to be left", 100 * kept, 100 * noise)
    return image


def _pilot_noise(image: F32, enough: bool) -> float:
    """`noise_of` a pilot; that few walks found nothing does not say that there is nothing."""
    found = noise_of(image)
    return math.inf if found == 0.0 and not enough else found


def from_light(transport: Transport, light: Light, camera: PinholeCamera, seed: int) -> Render:
    """Walks that start at the light, for one camera."""
    split = towards_view(transport, light, camera)

    def render(walks: int, run: int) -> F32:
        streams = len(HALVES) * run + np.arange(len(HALVES), dtype=np.uint32)
        traced = transport.trace(
            lambda group: light_source(light, transport.radius, group), len(HALVES), walks,
            seed=seed, streams=streams, cameras=[camera], layers=len(LAYERS), split=split, even=True,
        )  # fmt: skip
        assert traced.images is not None
        return traced.images[:, :, 0]

    return render


def from_pixels(transport: Transport, light: Sky, camera: PinholeCamera, noise: float, seed: int) -> Render:
    """Walks that start at the pixels of one camera and meet the light where they leave; so many a pixel."""

    def render(walks: int, run: int) -> F32:
        image = _sky_image(transport, light, camera, walks, seed, run)
        if run == 0:  # the surface reflects few of them
            image[:, LAYERS.index("surface")] = reflected_sky(transport, light, camera, noise, seed)
        return image

    return render


def reflected_sky(transport: Transport, light: Sky, camera: PinholeCamera, noise: float, seed: int) -> F32:
    """(2, L, H, W) both halves of what the surface reflects of a light from all around."""
    walks = max(1, round(SHINE / noise**2))
    image = _sky_image(transport, light, camera, walks, seed, SHINE_RUN, shine=True)
    return np.asarray(image[:, LAYERS.index("surface")])


def _sky_image(
    transport: Transport, light: Sky, camera: PinholeCamera, walks: int, seed: int, run: int, shine: bool = False
) -> F32:
    """(2, 2, L, H, W) from walks that start at the pixels; those that cannot see the object are black."""
    pixels = candidate_pixels(camera, transport.vertices, transport.faces)
    image = np.zeros((len(HALVES), len(LAYERS), transport.lasers, camera.height * camera.width), np.float32)
    if shine and transport.object.boundary.kind == "matched":
        return image.reshape(*image.shape[:-1], camera.height, camera.width)
    tags = np.concatenate([pixels] * len(HALVES))
    half = np.repeat(np.arange(len(HALVES)), len(pixels))
    streams = (64 * tags + (len(HALVES) * run + half) % 64).astype(np.uint32)
    traced = transport.trace(
        lambda group: PixelSource(camera, tags, len(group)), len(tags), walks,
        seed=seed, streams=streams, layers=len(LAYERS), shine=shine,
        sky=lambda group: sky_source(light, transport.radius, group),
    )  # fmt: skip
    assert traced.images is not None
    found = traced.images[:, :, 0, :, 0, 0].reshape(len(HALVES), len(pixels), len(LAYERS), -1)
    image[..., pixels] = np.moveaxis(found, 1, -1)
    return image.reshape(*image.shape[:-1], camera.height, camera.width)


def towards_view(transport: Transport, light: Light, camera: PinholeCamera) -> Views | None:
    """What windows lead a light's photons to; None for a beam that misses the object, or where the camera sees none."""
    source = light_source(light, transport.radius, range(transport.lasers))
    number = dr.arange(mi.UInt32, ENTRIES)
    start, direction, _ = source.launch(Rng.of(mi.UInt32(0), mi.UInt32(0), number), dr.zeros(mi.UInt32, ENTRIES), True)
    rays = np.broadcast_to(np.array(start).T, (ENTRIES, 3)), np.broadcast_to(np.array(direction).T, (ENTRIES, 3))
    entries, seen = first_hits(transport, *rays), first_hits(transport, *camera.rays(camera.pixel_centres()))
    return Views(entries, (seen,)) if len(entries) and len(seen) else None


def first_hits(transport: Transport, origins: F64, directions: F64) -> F64:
    """(M, 3) where those of the rays (N, 3) that meet the object do so first."""
    ray = mi.Ray3f(
        mi.Point3f(np.ascontiguousarray(origins.T, np.float32)),
        mi.Vector3f(np.ascontiguousarray(directions.T, np.float32)),
    )
    hit = transport.scene.ray_intersect(ray, mi.RayFlags.Minimal, True, True)
    return np.asarray(np.array(hit.p).T[np.array(hit.is_valid())], np.float64)
