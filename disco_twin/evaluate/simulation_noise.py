"""The simulation's noise beside the camera's: what a scene's walks buy, predicted and measured.

A walk adds a splat of about the same radiance s to whichever pixel it reaches, so a pixel of mean radiance L has the
variance s L / walks, from the peak down (docs/decisions/0053); where split walks meet it as well, their density adds.
The camera's own variance is known for every radiance. Decades are those of light below the brightest of a spot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.camera.sensor import expected_variance
from disco_twin.experiment.experiment import Experiment
from disco_twin.light import MOST_CAMERAS
from disco_twin.light.importance import Diffusion, diffusion
from disco_twin.light.spot_walks import SpotWalks, photon_density, walk_seconds
from disco_twin.scene.scene import DEFAULT_WALKS, Scene
from hw.base.arrays import F32, F64, I64
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.mesh import RayMesh

RADIANCES = np.geomspace(1e-12, 1e-3, 400)  # W/(mm^2 sr), from below the camera's noise to its saturation
FILES = 3  # of simulated spots that are looked at, evenly spread
BOX = 5  # pixels along each side over which a pixel's variance and light are averaged
DECADES = 7  # the last one holds all that is fainter
SPOTS = 6  # for which a prediction is made
CELLS = 24  # along the object, of the estimate
PROBE_WALKS = 1 << 20  # a spot: noise is predicted for so many, and scaled
MOST_WALKS = (1 << 32) - 1


def splat(scene: Scene) -> float:
    """Radiance per watt launched that one walk adds to a pixel that it reaches, in the nearest camera, 1/(mm^2 sr).

    By the g of the base: features are taken for a small part.
    """
    boundary, g = scene.object.boundary, float(np.max(np.abs(scene.object.medium.g)))
    cameras = [PinholeCamera.from_config(c) for c in scene.rig.cameras]
    unit = max(float(c.focal.prod() / (c.position @ c.position)) for c in cameras)
    share = splat_share(None if boundary.kind == "matched" else boundary.alpha, boundary.eta, g)
    return share * unit * max(1.0, len(cameras) / MOST_CAMERAS)  # each of those that are drawn counts for several


def splat_share(alpha: float | None, eta: float, g: float) -> float:
    """Splat in units of focal length^2 / distance^2 (pixels), of a rough boundary or of none (alpha None): within a
    factor of three for alpha of .05 to .5, eta up to 1.7 and g up to .8, of five beyond (docs/decisions/0053).
    """
    base = 0.17 if alpha is None else (0.05 + 0.028 / max(alpha, 0.02)) * (1.3 / eta) ** 4
    return base / (1 - g)


def walks_below_camera(scene: Scene) -> float:
    """Walks a spot at which the simulation's noise falls below the camera's in every pixel."""
    sensor, s = lars3_sensor(scene.rig), splat(scene)
    return max(
        float((laser.power_mw * 1e-3 * s * RADIANCES / expected_variance(RADIANCES, sensor, k)).max())
        for k, laser in enumerate(scene.rig.lasers)
    )


@dataclass(frozen=True)
class SpotCost:
    """What a spot's light takes, as the scene states it. time_walks: the time of so many plain ones; walks: those that
    are made of it; seconds: of a core; median, by_decade: the simulation's predicted deviation over the camera's:
    to decade -3 within a factor of three, the median within five, fainter ones too large (quick: 23 92 259 413 350 245,
    median 348; measured 32 105 290 273 111 24, median 106), since what no photon reached shows no noise.
    """

    time_walks: int
    walks: SpotWalks
    seconds: float
    median: float
    by_decade: dict[str, float]


def spot_cost(experiment: Experiment) -> SpotCost:
    """The cost of a spot and the noise that is left, by the diffusion estimate.

    Raises: InputError as `build_object`.
    """
    work = experiment.scene.simulation
    estimate = coarse_estimate(experiment)
    places = experiment.scan.vertices[lit_vertices(experiment)]
    each = walk_seconds(experiment.object, estimate.collisions(places))
    median, by_decade = _predicted_noise(experiment, estimate, places)
    if work.spot_seconds is not None:
        walks = work.spot_seconds / each
    elif work.spot_noise is not None:
        walks = PROBE_WALKS * (median / work.spot_noise) ** 2
    else:
        walks = float(work.walks_per_spot or DEFAULT_WALKS)
    count = int(min(max(round(walks), 1), MOST_WALKS))
    scale = math.sqrt(PROBE_WALKS / count)
    parts = SpotWalks.of(count, work.split_share)
    return SpotCost(count, parts, count * each, scale * median, {d: scale * x for d, x in by_decade.items()})


def coarse_estimate(experiment: Experiment) -> Diffusion:
    """The diffusion estimate at the wavelength that is absorbed least, good enough to predict time and noise."""
    medium = experiment.object.medium
    absorbed = [float((s * (1 - a)).mean()) for s, a in zip(medium.sigma_t, medium.albedo, strict=True)]
    return diffusion(experiment.object, int(np.argmin(absorbed)), CELLS)


def lit_vertices(experiment: Experiment) -> I64:
    """(SPOTS,) vertices of the scan that face the projector, evenly spread over their list."""
    scan = experiment.scan
    towards = np.array(experiment.scene.rig.projector.position_mm) - scan.vertices
    facing = np.flatnonzero((towards * scan.vertex_normals).sum(axis=1) > 0.3 * np.linalg.norm(towards, axis=1))
    facing = facing if len(facing) else np.arange(len(scan.vertices))
    return np.asarray(facing[np.linspace(0, len(facing) - 1, SPOTS).round().astype(int)])


def _predicted_noise(experiment: Experiment, estimate: Diffusion, places: F64) -> tuple[float, dict[str, float]]:
    """Deviation over the camera's with PROBE_WALKS: in the median of the pixels that show the object, and by decade."""
    scene, scan = experiment.scene, experiment.scan
    fluence = estimate.fluence(places)
    at = estimate.unknowns(scan.vertices)
    light = fluence[:, estimate.filled][:, at] * estimate.leak / np.pi
    density = photon_density(estimate, fluence, SpotWalks.of(PROBE_WALKS, scene.simulation.split_share))[
        :, estimate.filled
    ][:, at]
    size, area = np.zeros(len(scan.vertices)), RayMesh.of(scan).vertex_areas
    for camera in map(PinholeCamera.from_config, scene.rig.cameras):
        towards = camera.position - scan.vertices
        size += area * np.maximum((towards * scan.vertex_normals).sum(axis=1), 0) / np.linalg.norm(towards, axis=1) ** 3
    sensor, s, ratios = lars3_sensor(scene.rig), splat(scene), []
    for k, laser in enumerate(scene.rig.lasers):
        watts = laser.power_mw * 1e-3
        ratios.append(watts**2 * s * light / density / expected_variance(watts * light, sensor, k))
    ratio = np.sqrt(np.stack(ratios))
    decade = np.broadcast_to(_decade(light, light.max(axis=1, keepdims=True)), ratio.shape)
    weight = np.broadcast_to(size, ratio.shape)
    by_decade = {
        str(-d): _median(ratio[decade == d], weight[decade == d]) for d in range(DECADES) if (decade == d).any()
    }
    return _median(ratio, weight), by_decade


def _decade(light: F64, peak: F64) -> F64:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.clip(np.floor(-np.log10(light / peak)), 0, DECADES - 1))


def _median(values: F64, weight: F64) -> float:
    order = np.argsort(values, axis=None)
    total = np.cumsum(weight.ravel()[order])
    return float(values.ravel()[order][np.searchsorted(total, total[-1] / 2)])


def measured_noise(scene: Scene, responses: Path) -> dict[str, Any] | None:
    """`noise_of` the simulated spots that a run has kept; None without any."""
    files = sorted(responses.glob("spots-*.npy"))
    if not files:
        return None
    some = np.unique(np.linspace(0, len(files) - 1, FILES).round().astype(int))
    return noise_of(scene, [np.load(files[index], mmap_mode="r") for index in some])


def noise_of(scene: Scene, spots: Sequence[F32]) -> dict[str, Any] | None:
    """The simulation's noise beside the camera's, from how the halves of the walks differ; None without light.

    spots: (2, S, C, L, H, W) each, the images of some spots at one turntable angle and those of half of their walks.
    Of all pixels that show the object (that light reached in any of them): median_over_camera and p90_over_camera of
    the ratio of the deviations, the shares where it is above one and above ten, and the share that no light reached,
    which counts as above ten. A pixel's variance is the mean over BOX x BOX pixels. by_decade: of light below the
    spot's brightest, the root mean square ratio and the share of pixels.
    """
    sensor = lars3_sensor(scene.rig)
    found: list[tuple[F64, F64, F64, F64]] = []  # ratio, squared ratio without averaging, decade, light
    for arrays in spots:
        mean, first_half = np.asarray(arrays, np.float64)
        square = (first_half - mean) ** 2
        shown = np.broadcast_to((mean > 0).any(axis=(0, 2))[None, :, None], mean.shape)
        filled = np.maximum(_boxes(shown.astype(float)), 1e-12)
        light, variance = (np.maximum(_boxes(images), 0.0) / filled for images in (mean, square))
        decade = _decade(light, light.max(axis=(1, 2, 3, 4), keepdims=True))
        for k, laser in enumerate(scene.rig.lasers):
            watts, part = laser.power_mw * 1e-3, shown[:, :, k]
            camera = expected_variance(watts * light[:, :, k], sensor, k) / watts**2
            ratio = np.where(light[:, :, k] > 0, np.sqrt(variance[:, :, k] / camera), np.inf)
            rows = ratio, square[:, :, k] / camera, decade[:, :, k], mean[:, :, k]
            found.append(tuple(row[part] for row in rows))
    ratio, squared, decade, seen = (np.concatenate([f[n] for f in found]) for n in range(4))
    if not ratio.size:
        return None
    median, p90 = (float(np.quantile(ratio, q, method="lower")) for q in (0.5, 0.9))
    return {
        "median_over_camera": median if math.isfinite(median) else None,
        "p90_over_camera": p90 if math.isfinite(p90) else None,
        "above_camera_object": float((ratio > 1).mean()),
        "above_ten_object": float(((ratio > 10) | (seen == 0)).mean()),
        "unreached_object": float((seen == 0).mean()),
        "by_decade": {
            str(-d): {"over_camera": float(np.sqrt(squared[decade == d].mean())), "share": float((decade == d).mean())}
            for d in range(DECADES)
            if (decade == d).any()
        },
    }


def _boxes(images: F64) -> F64:
    """Means over BOX x BOX pixels of the last two axes; nothing lies beyond an image's rim."""
    kernel = (1,) * (images.ndim - 2) + (BOX, BOX)
    return np.asarray(ndimage.uniform_filter(images, kernel, mode="constant"))
