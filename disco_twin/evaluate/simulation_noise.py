"""The simulation's noise beside the camera's: what a scene's walks buy, predicted and measured.

A walk adds a splat of about the same radiance s to whichever pixel it reaches, so a pixel of mean radiance L has the
variance s L / walks, from the peak down (docs/decisions/0053). The camera's own variance is known for every radiance.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.camera.sensor import expected_variance
from disco_twin.light import MOST_CAMERAS
from disco_twin.scene.scene import Scene
from pipeline.geometry.camera import PinholeCamera

RADIANCES = np.geomspace(1e-12, 1e-3, 400)  # W/(mm^2 sr), from below the camera's noise to its saturation
FILES = 3  # of simulated spots that are looked at, evenly spread


def splat(scene: Scene) -> float:
    """Radiance per watt launched that one walk adds to a pixel that it reaches, in the nearest camera, 1/(mm^2 sr)."""
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


def measured_noise(scene: Scene, responses: Path) -> dict[str, Any] | None:
    """The simulated spots' variances beside the camera's, over pixels that a walk reached; None without any.

    median_over_camera: of the standard deviations' ratio; above_camera: share of pixels where it exceeds one;
    walks_below_camera: walks a spot that would bring it below one in 99 of 100 of these pixels.
    """
    files = sorted(responses.glob("spots-*.npy"))
    if not files:
        return None
    sensor, ratios = lars3_sensor(scene.rig), []
    for index in np.unique(np.linspace(0, len(files) - 1, FILES).round().astype(int)):
        path = files[index]
        mean, variance = np.load(path, mmap_mode="r")
        for k, laser in enumerate(scene.rig.lasers):
            watts = laser.power_mw * 1e-3
            lit = np.asarray(mean[:, :, k] > 0)
            radiance = watts * np.asarray(mean[:, :, k], float)[lit]
            ratios.append(watts**2 * np.asarray(variance[:, :, k], float)[lit] / expected_variance(radiance, sensor, k))
    ratio = np.concatenate(ratios)
    if not ratio.size:
        return None
    walks = scene.simulation.walks_per_spot
    return {
        "walks_per_spot": walks,
        "median_over_camera": float(np.sqrt(np.median(ratio))),
        "above_camera": float((ratio > 1).mean()),
        "walks_below_camera": float(walks * np.quantile(ratio, 0.99)),
    }
