"""From the stream to samples of R_d: all views of one illumination together (thesis 5.3.1).

A pixel that sees the surface under the direction w_o shows L = F_t(w_o) / pi * R_d * F_t(w_i) * Phi (eq. 2.1 for a
beam of power Phi; no foreshortening cosine, since the whole beam enters). So R_d = pi L / (F_t(w_i) F_t(w_o) Phi).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage, sparse

from hw.record import RadianceImage
from pipeline.calibrate.calibration import Calibration
from pipeline.calibrate.camera import PinholeCamera
from pipeline.capture.plan import ImageAddress, Plan
from pipeline.capture.stream import CorruptImage, StreamReader
from pipeline.reconstruct.distances import Pairs, lit_hats, spot_pairs, vertex_pairs
from pipeline.reconstruct.settings import ReconstructConfig
from pipeline.reconstruct.spots import Spots, locate_spots, outward_tilt
from pipeline.reconstruct.views import Reading

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

log = logging.getLogger(__name__)

MIN_SHARE = 0.5  # of a vertex's hat that a camera must see
# Relative scatter of samples of one entry that differ in direction: all of them, and what oblique ones add. Measured as
# the spread about a completed quick scene within two edges of the spots (docs/decisions/0013).
ANGULAR, OBLIQUE = 0.1, 0.5
# Its response to white noise has the noise's variance, and none to a linear slope (Immerkaer 1996).
NOISE_MASK = np.outer([1, -2, 1], [1, -2, 1]) / 6.0


@dataclass(frozen=True)
class Glow:
    """One view's sum of images over its spots, each as pi L / (F_t(w_i) Phi), so that the power of spots is 1.

    camera: in the object frame; image: (L, H, W) mm^-2; included: (L, S) the spots in the sum
    """

    camera: PinholeCamera
    image: F64
    included: NDArray[np.bool_]


@dataclass(frozen=True)
class Samples:
    """Measured R_d between spots and vertices.

    values: (L, S, V) mm^-2, NaN where not observed; averaged over the hat function of the vertex and over the beam
    dark_variance, noise_per_signal: (L, S, V); an entry of expectation m has variance dark + per_signal * m
    oblique: (S, V) relative variance that obliqueness adds at both ends (`oblique_variance`)
    tilt: (S, V) sum of `outward_tilt` at both ends, mean over the cameras
    glow: per view, images summed over its spots
    """

    mesh: trimesh.Trimesh
    eta: float
    spots: Spots
    values: F32
    dark_variance: F32
    noise_per_signal: F32
    oblique: F32
    tilt: F64
    glow: tuple[Glow, ...] = ()

    @property
    def variance(self) -> F32:
        """(L, S, V) variance of the values as measured, mm^-4."""
        return np.asarray(self.dark_variance + self.noise_per_signal * np.maximum(self.values, 0.0))

    @cached_property
    def spot_pairs(self) -> Pairs:
        """Distances between the beams and the hat functions."""
        return spot_pairs(self.mesh, self.spots)

    @cached_property
    def lit(self) -> sparse.csr_array:
        """(S, V) mean of each vertex's hat function over a beam's footprint; rows add up to 1."""
        return lit_hats(self.mesh, self.spots)

    @cached_property
    def vertex_pairs(self) -> Pairs:
        """Distances between the hat functions."""
        return vertex_pairs(self.mesh)


@dataclass(frozen=True)
class SampleStatistics:
    """What was left out, counted. Entries are (laser, spot, vertex); coverage is the share that was observed."""

    images: int
    corrupt: tuple[str, ...]
    saturated_pixels: int
    spots: int
    spots_too_oblique: int
    entries_in_highlight: int
    coverage: float


def oblique_variance(cosine: NDArray[np.floating]) -> F64:
    """Relative variance of a sample whose laser or camera meets the surface at this cosine; it grows fast below .5."""
    return np.asarray(OBLIQUE**2 * (1.0 - np.clip(cosine, 0.0, 1.0)) ** 8, np.float64)


def noise_squared(image: NDArray[np.floating]) -> F64:
    """(H, W) local estimate of each pixel's noise variance from its 3 x 3 neighbourhood, exact on average."""
    return np.asarray(ndimage.convolve(np.asarray(image, np.float64), NOISE_MASK, mode="nearest") ** 2)


class _Gathered:
    """Readings of all spots by all cameras: (L, S, C, V) arrays for one way of reading.

    value in mm^-2; its variance in mm^-4: dark, without signal; noise, as the image shows; shot, by the camera's model
    """

    def __init__(self, lasers: int, plan: Plan, readings: list[Reading]) -> None:
        cameras, vertices = len(plan.cameras), readings[0].operator.shape[0]
        shape = (lasers, len(plan.spots), cameras, vertices)
        self.readings, self.plan = readings, plan
        self.squared = [r.operator.multiply(r.operator).tocsr() for r in readings]
        self.touched = [abs(r.operator).tocsr() for r in readings]
        self.value = np.full(shape, np.nan, np.float32)
        self.dark = np.zeros(shape, np.float32)
        self.noise = np.zeros(shape, np.float32)
        self.shot = np.zeros(shape, np.float32)

    def add(self, address: ImageAddress, image: RadianceImage, noise: F64, scale: float) -> None:
        view, camera = address.view, self.plan.camera_of(address.view)
        at = (address.laser, address.spot, camera)
        reading = self.readings[view]
        value = reading.operator @ image.radiance.ravel().astype(np.float64) * scale
        seen = reading.share > MIN_SHARE
        if image.saturated.any():
            seen &= self.touched[view] @ image.saturated.ravel().astype(np.float64) == 0
        self.value[at] = np.where(seen, value, np.nan)
        self.dark[at] = self.squared[view] @ np.full(noise.size, float(image.variance.min())) * scale**2
        self.noise[at] = self.squared[view] @ noise.ravel() * scale**2
        self.shot[at] = self.squared[view] @ image.variance.ravel() * scale**2

    def noise_per_signal(self) -> F32:
        """(L, S, C, V) variance per signal; a property of laser, view and vertex, so averaged over a view's spots.

        As seen in the images, but not less than what the camera's own model says.
        """
        out = np.zeros_like(self.value)
        for angle in range(len(self.plan.angles_rad)):
            spots = self.plan.spots_at(angle)
            part = np.s_[:, spots.start : spots.stop]
            read = np.isfinite(self.value[part])
            signal = np.where(read, np.maximum(self.value[part], 0.0), 0.0)
            # Clipped after the mean: single estimates scatter to both sides, and clipping each would raise them all.
            seen, own = (
                np.maximum(np.where(read, v[part] - self.dark[part], 0.0).sum(axis=1, keepdims=True), 0.0)
                for v in (self.noise, self.shot)
            )
            extra, total = np.maximum(seen, own), signal.sum(axis=1, keepdims=True)
            mean = extra.sum(axis=3, keepdims=True) / np.maximum(total.sum(axis=3, keepdims=True), 1e-30)
            out[part] = np.where(total > 0, extra / np.maximum(total, 1e-30), mean)
        return out

    def expected(self, distance: F64) -> F64:
        """(L, S, V) what a sample is about, mm^-2: the mean over all that lie as far from their spots (`distance`).

        Weights must not come from the samples that they weigh: low ones would seem precise.
        """
        nearest = np.partition(distance, 40, axis=None)[40]  # enough entries in the first bin
        edges = np.geomspace(nearest, distance.max(), 40)
        count = len(edges) + 1
        group = np.searchsorted(edges, distance).ravel()
        out = []
        for value in self.value:
            seen = np.isfinite(value)
            n = np.bincount(group, seen.sum(axis=1).ravel(), count)
            total = np.bincount(group, np.where(seen, value, 0.0).sum(axis=1, dtype=np.float64).ravel(), count)
            mean = total / np.maximum(n, 1)
            out.append(np.maximum(mean, 1e-6 * max(mean.max(), 1e-30))[group].reshape(distance.shape))
        return np.stack(out)

    def combined(self, mesh: trimesh.Trimesh, eta: float, spots: Spots, glow: tuple[Glow, ...]) -> Samples:
        """One value per laser, spot and vertex: the cameras' mean by the share of the footprint seen and by precision.

        Precision is that expected at the entry: noise, scatter between directions, obliqueness of the view.
        """
        shape = self.value.shape[1:]
        share, oblique, tilt = (np.zeros(shape, np.float32) for _ in range(3))
        for view, reading in enumerate(self.readings):
            rows = self.plan.spots_at(self.plan.angle_of(view))
            at = np.s_[rows.start : rows.stop, self.plan.camera_of(view)]
            share[at], oblique[at] = reading.share, oblique_variance(reading.cosine)
            at_vertices, at_spots = outward_tilt(mesh, spots, glow[view].camera.position)
            tilt[at] = (at_vertices + at_spots)[rows.start : rows.stop]
        slope = self.noise_per_signal()
        distance = np.linalg.norm(spots.position[:, None] - np.asarray(mesh.vertices), axis=2)
        expected = self.expected(distance)[:, :, None]
        relative = (self.dark + slope * expected) / expected**2 + ANGULAR**2 + oblique
        weight = np.where(np.isfinite(self.value), share / relative, 0.0)
        weight /= np.maximum(weight.sum(axis=2, keepdims=True), 1e-30)
        value = np.where(weight > 0, weight * self.value, 0.0).sum(axis=2)
        seen = weight.sum(axis=2) > 0
        common = weight.mean(axis=0)  # of directions, which the lasers share
        common /= np.maximum(common.sum(axis=1, keepdims=True), 1e-30)
        incidence = oblique_variance(-(spots.normal * spots.direction).sum(axis=1))
        return Samples(
            mesh,
            eta,
            spots,
            np.where(seen, value, np.nan).astype(np.float32),
            (weight**2 * self.dark).sum(axis=2).astype(np.float32),
            (weight**2 * slope).sum(axis=2).astype(np.float32),
            (incidence[:, None] + (common * oblique).sum(axis=1)).astype(np.float32),
            (common * tilt).sum(axis=1).astype(np.float64),
            glow,
        )


def take_samples(
    stream: StreamReader,
    calibration: Calibration,
    mesh: trimesh.Trimesh,
    readings: Mapping[str, list[Reading]],
    settings: ReconstructConfig,
) -> tuple[dict[str, Samples], SampleStatistics]:
    """Read every spot image once. `readings`: per way of reading, one `Reading` per view; the keys of the result."""
    plan, lasers = stream.plan, len(calibration.lasers)
    spots = locate_spots(mesh, calibration, plan, settings)
    gathered = {name: _Gathered(lasers, plan, views) for name, views in readings.items()}
    addresses = [a for a in plan.addresses() if a.kind == "spot" and spots.transmitted[a.spot] > 0]
    glow = tuple(_no_glow(calibration.view_camera(v), lasers, len(plan.spots)) for v in range(plan.views))
    corrupt, saturated = [], 0
    for address, raw in zip(addresses, stream.read_many(addresses), strict=True):
        if isinstance(raw, CorruptImage):
            log.warning("%s", raw)
            corrupt.append(str(address))
            continue
        power = stream.meta(address).photodiode_w
        if not power > 0:
            log.warning("%s: the photodiode saw no light; image left out", address)
            corrupt.append(str(address))
            continue
        image = calibration.radiance(raw, address.view, address.laser)
        saturated += int(image.saturated.sum())
        noise = noise_squared(image.radiance)
        scale = np.pi / (spots.transmitted[address.spot] * power)
        glow[address.view].image[address.laser] += image.radiance * scale
        glow[address.view].included[address.laser, address.spot] = True
        for g in gathered.values():
            g.add(address, image, noise, scale)
    masked = sum(_mask_highlights(g, spots, calibration, mesh, settings.highlight_deg) for g in gathered.values())
    samples = {name: g.combined(mesh, settings.eta, spots, glow) for name, g in gathered.items()}
    first = next(iter(samples.values()))
    statistics = SampleStatistics(
        images=len(addresses),
        corrupt=tuple(corrupt),
        saturated_pixels=saturated,
        spots=len(plan.spots),
        spots_too_oblique=int((spots.transmitted == 0).sum()),
        entries_in_highlight=masked // max(len(gathered), 1),
        coverage=float(np.isfinite(first.values).mean()),
    )
    return samples, statistics


def _no_glow(camera: PinholeCamera, lasers: int, spots: int) -> Glow:
    return Glow(camera, np.zeros((lasers, camera.height, camera.width)), np.zeros((lasers, spots), bool))


def _mask_highlights(
    gathered: _Gathered, spots: Spots, calibration: Calibration, mesh: trimesh.Trimesh, limit_deg: float
) -> int:
    """Blank what a camera near the beam's mirror direction reads inside the beam; returns the number of entries."""
    count = 0
    reach = spots.beam_radius + float(mesh.edges_unique_length.mean())
    plan = gathered.plan
    for view in range(plan.views):
        towards = calibration.view_camera(view).position - spots.position
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        half = towards - spots.direction
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        close = (half * spots.normal).sum(axis=1) > np.cos(np.deg2rad(limit_deg))
        for spot in plan.spots_at(plan.angle_of(view)):
            if close[spot] and spots.transmitted[spot] > 0:
                lit = np.linalg.norm(mesh.vertices - spots.position[spot], axis=1) < reach
                entries = gathered.value[:, spot, plan.camera_of(view)]
                count += int(np.isfinite(entries[:, lit]).sum())
                entries[:, lit] = np.nan
    return count


def select_lasers(samples: Samples, lasers: NDArray[np.int64]) -> Samples:
    """The samples of some of the lasers."""
    return replace(
        samples,
        values=samples.values[lasers],
        dark_variance=samples.dark_variance[lasers],
        noise_per_signal=samples.noise_per_signal[lasers],
        glow=tuple(replace(g, image=g.image[lasers], included=g.included[lasers]) for g in samples.glow),
    )
