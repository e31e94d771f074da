"""From the stream to samples of R_d: all views of one illumination together (thesis 5.3.1).

A pixel that sees the surface under the direction w_o shows L = F_t(w_o) / pi * R_d * F_t(w_i) * Phi (eq. 2.1 for a
beam of power Phi; no foreshortening cosine, since the whole beam enters). So R_d = pi L / (F_t(w_i) F_t(w_o) Phi).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse

from hw.base.arrays import F32, F64, I64, Bool
from pipeline.calibrate.calibration import Calibration
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.mesh import RayMesh
from pipeline.plan.plan import Plan
from pipeline.reconstruct.samples.distances import Pairs, beam_footprints, spot_pairs, vertex_pairs
from pipeline.reconstruct.samples.image_operators import ImageOperator
from pipeline.reconstruct.samples.resample import BatchResult, Sums, ViewReader, look_up, resample
from pipeline.reconstruct.samples.spots import Spots, locate_spots, tilts
from pipeline.reconstruct.samples.surface_lobe import BeamOnHats, BeamReadings, SurfaceLobe
from pipeline.reconstruct.settings import ReconstructConfig
from pipeline.stream.stream import StreamReader

# Relative scatter of samples of one entry that differ in direction: all of them, and what oblique ones add. Measured as
# the spread about a completed quick scene within two edges of the spots (docs/decisions/0013).
ANGULAR, OBLIQUE = 0.1, 0.5


@dataclass(frozen=True)
class SpotSumImage:
    """One view's sum of images over its spots, each as pi L / (F_t(w_i) Phi), so that the power of spots is 1.

    camera: in the object frame; image: (L, H, W) mm^-2; included: (L, S) the spots in the sum
    """

    camera: PinholeCamera
    image: F64
    included: Bool


@dataclass(frozen=True)
class Samples:
    """Measured R_d between spots and vertices.

    values: (L, S, V) mm^-2, NaN where not observed; averaged over the hat function of the vertex and over the beam
    dark_variance, noise_per_signal: (L, S, V); an entry of expectation m has variance dark + per_signal * m; dark holds
        what a reflection that was taken off leaves open, too
    oblique: (S, V) relative variance that obliqueness adds at both ends (`oblique_variance`)
    tilt: (S, V) sum of `tilts` at both ends, mean over the cameras
    cosine: (S, V) between normal and direction to the camera, mean over the cameras; 0 where not observed
    glow: per view, images summed over its spots
    read_in_beams: which cameras read the vertices that the beams meet
    lobe: what of the surface's reflection was taken off the values; None where nobody has looked for it
    """

    mesh: trimesh.Trimesh
    eta: float
    spots: Spots
    values: F32
    dark_variance: F32
    noise_per_signal: F32
    oblique: F32
    tilt: F64
    cosine: F32
    glow: tuple[SpotSumImage, ...] = ()
    read_in_beams: BeamReadings = field(default_factory=BeamReadings.none)
    lobe: SurfaceLobe | None = None

    @cached_property
    def edge(self) -> float:
        """Mean length of the scan's edges, mm."""
        return float(self.mesh.edges_unique_length.mean())

    def with_readings(self, **fields: Any) -> Samples:
        """Other readings of the same spots and vertices: what was prepared from where those lie stays.

        Raises: ValueError for other spots or another mesh.
        """
        if not fields.keys().isdisjoint({"mesh", "spots"}):
            raise ValueError("spots and mesh are what readings are of: make new samples instead")
        of_places = ("edge", "spot_pairs", "lit", "vertex_pairs")
        other = replace(self, **fields)
        vars(other).update({name: made for name, made in vars(self).items() if name in of_places})
        return other

    @property
    def variance(self) -> F32:
        """(L, S, V) variance of the values as measured, mm^-4."""
        return np.asarray(self.dark_variance + self.noise_per_signal * np.maximum(self.values, 0.0))

    @cached_property
    def shared(self) -> dict[Any, Any]:
        """What methods work out of these readings alone and hand on to each other, by keys of their own."""
        return {}

    @cached_property
    def spot_pairs(self) -> Pairs:
        """Distances between the beams and the hat functions."""
        return spot_pairs(self.mesh, self.spots)

    @cached_property
    def lit(self) -> sparse.csr_array:
        """(S, V) mean of each vertex's hat function over a beam's footprint; rows add up to 1."""
        return beam_footprints(self.mesh, self.spots)

    @property
    def beams(self) -> BeamOnHats:
        """The beams where they meet the scan, and the cameras that read it there."""
        density = sparse.csr_array(self.lit / RayMesh.of(self.mesh).vertex_areas)
        return BeamOnHats(self.spots, self.eta, density, tuple(g.camera for g in self.glow), self.read_in_beams)

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


class _Gathered:
    """Readings of all spots by all cameras, by one sampling (footprint, bilinear).

    value: (L, S, C, V) mm^-2, NaN where not observed
    scale: (L, S, C) what the images' radiances were multiplied with (`BatchResult`), 0 where one is missing
    noise, shot: (L, views, V) mm^-4, variance summed over the values of a view: as the images show it, and by the
        camera's model; dark: (L, views, V) variance of an image without signal, as of radiance / F_t
    """

    def __init__(self, lasers: int, plan: Plan, readings: list[ImageOperator]) -> None:
        cameras, vertices = len(plan.cameras), len(readings[0].share)
        self.readings, self.plan = readings, plan
        self.value = np.full((lasers, len(plan.spots), cameras, vertices), np.nan, np.float32)
        self.scale = np.zeros((lasers, len(plan.spots), cameras))
        self.noise, self.shot, self.dark = (np.zeros((lasers, plan.views, vertices)) for _ in range(3))

    def block(self, view: int) -> tuple[slice, int]:
        """(spots, camera) of a view in `value` and `scale`."""
        spots = self.plan.spots_at(self.plan.angle_of(view))
        return slice(spots.start, spots.stop), self.plan.camera_of(view)

    def add(self, sampling: str, result: BatchResult) -> None:
        """What came of some images."""
        view, laser = result.batch.reader.view, result.batch.laser
        rows, camera = result.batch.reader.rows[sampling], self.plan.camera_of(view)
        for address, value, scale in zip(result.batch.addresses, result.value[sampling], result.scale, strict=True):
            self.value[laser, address.spot, camera, rows] = value
            self.scale[laser, address.spot, camera] = scale
        self.noise[laser, view, rows] += result.alone[sampling][0]
        self.shot[laser, view, rows] += result.alone[sampling][1]

    def add_noise(self, reader: ViewReader, sampling: str, laser: int, sums: Sums, dark: float) -> None:
        """The sums over all images of a view and laser. dark: a dark pixel's variance before the lens's gain."""
        rows, operator = reader.rows[sampling], reader.operators[sampling].astype(np.float64)
        squared = operator.multiply(operator).tocsr()
        self.noise[laser, reader.view, rows] += squared @ sums.noise_variance().ravel()
        self.shot[laser, reader.view, rows] += squared @ sums.shot.ravel()
        self.dark[laser, reader.view, rows] = dark * squared.sum(axis=1)

    def dark_variance(self) -> F32:
        """(L, S, C, V) mm^-4, variance of the values without signal."""
        out = np.zeros_like(self.value)
        for view in range(self.plan.views):
            spots, camera = self.block(view)
            out[:, spots, camera] = self.scale[:, spots, camera, None] ** 2 * self.dark[:, view, None]
        return out

    def noise_per_signal(self) -> F32:
        """(L, S, C, V) variance per signal; a property of laser, view and vertex, so averaged over a view's spots.

        As seen in the images, but not less than what the camera's own model says.
        """
        out = np.zeros_like(self.value)
        for view in range(self.plan.views):
            spots, camera = self.block(view)
            value = self.value[:, spots, camera]
            read = np.isfinite(value)
            total = np.where(read, np.maximum(value, 0.0), 0.0).sum(axis=1)
            dark = np.where(read, self.scale[:, spots, camera, None] ** 2, 0.0).sum(axis=1) * self.dark[:, view]
            # Clipped after the sum: single estimates scatter to both sides, and clipping each would raise them all.
            extra = np.maximum(np.maximum(self.noise[:, view], self.shot[:, view]) - dark, 0.0)
            mean = extra.sum(axis=1, keepdims=True) / np.maximum(total.sum(axis=1, keepdims=True), 1e-30)
            out[:, spots, camera] = np.where(total > 0, extra / np.maximum(total, 1e-30), mean)[:, None]
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

    def combined(self, mesh: trimesh.Trimesh, eta: float, spots: Spots, glow: tuple[SpotSumImage, ...]) -> Samples:
        """One value per laser, spot and vertex: the cameras' mean by the share of the footprint seen and by precision.

        Precision is that expected at the entry: noise, scatter between directions, obliqueness of the view.
        """
        shape = self.value.shape[1:]
        share, oblique, tilt, cosine = (np.zeros(shape, np.float32) for _ in range(4))
        for view, reading in enumerate(self.readings):
            at = self.block(view)
            share[at], oblique[at], cosine[at] = reading.share, oblique_variance(reading.cosine), reading.cosine
            leaving, entering = tilts(mesh, spots, glow[view].camera.position, eta)
            tilt[at] = (leaving + entering)[at[0]]
        dark, slope = self.dark_variance(), self.noise_per_signal()
        distance = np.linalg.norm(spots.position[:, None] - np.asarray(mesh.vertices), axis=2)
        expected = self.expected(distance)[:, :, None]
        relative = (dark + slope * expected) / expected**2 + ANGULAR**2 + oblique
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
            (weight**2 * dark).sum(axis=2).astype(np.float32),
            (weight**2 * slope).sum(axis=2).astype(np.float32),
            (incidence[:, None] + (common * oblique).sum(axis=1)).astype(np.float32),
            (common * tilt).sum(axis=1).astype(np.float64),
            (common * cosine).sum(axis=1).astype(np.float32),
            glow,
            self.in_beams(beam_footprints(mesh, spots), common),
        )

    def in_beams(self, lit: sparse.csr_array, weight: F32) -> BeamReadings:
        """The readings of vertices that beams meet. lit: (S, V) nonzero there; weight: (S, C, V) of the cameras."""
        found = []
        for view in range(self.plan.views):
            spots, camera = self.block(view)
            at = sparse.coo_array(lit[spots])
            share = weight[spots, camera][at.row, at.col]
            kept = share > 0
            found.append((at.row[kept] + spots.start, at.col[kept], np.full(kept.sum(), view), share[kept]))
        spot, vertex, of_view = (np.concatenate([f[k] for f in found]).astype(np.int64) for k in range(3))
        return BeamReadings(spot, vertex, of_view, np.concatenate([f[3] for f in found]).astype(np.float64))


def take_samples(
    stream: StreamReader,
    calibration: Calibration,
    mesh: trimesh.Trimesh,
    readings: Mapping[str, list[ImageOperator]],
    settings: ReconstructConfig,
) -> tuple[dict[str, Samples], SampleStatistics]:
    """Read every spot image once. `readings`: per sampling, one `ImageOperator` per view; the keys of the result."""
    plan, lasers = stream.plan, len(calibration.lasers)
    spots = locate_spots(mesh, calibration, plan, settings)
    gathered = {sampling: _Gathered(lasers, plan, views) for sampling, views in readings.items()}
    readers = [
        ViewReader.of(view, calibration, mesh, {sampling: views[view] for sampling, views in readings.items()})
        for view in range(plan.views)
    ]
    cameras = [calibration.view_camera(view) for view in range(plan.views)]
    glow = tuple(
        SpotSumImage(c, np.zeros((lasers, c.height, c.width)), np.zeros((lasers, len(plan.spots)), bool))
        for c in cameras
    )
    sums = {(reader.view, laser): Sums.zeros(reader.gain.shape) for reader in readers for laser in range(lasers)}
    hidden = highlights(spots, calibration, plan, mesh, settings.highlight_deg)
    images, lost, saturated, masked = 0, [], 0, 0
    for result in resample(stream, calibration, readers, spots.transmitted, hidden):
        view, laser = result.batch.reader.view, result.batch.laser
        images += len(result.batch.addresses)
        lost += [str(address) for address in result.lost]
        saturated += result.saturated
        masked += result.hidden
        sums[view, laser] += result.sums
        glow[view].included[laser, [a.spot for a in result.batch.addresses]] = result.scale > 0
        for sampling, g in gathered.items():
            g.add(sampling, result)
    dark = [look_up(calibration.sensor, laser)[1].min() for laser in range(lasers)]
    for reader in readers:
        for laser in range(lasers):
            total = sums[reader.view, laser]
            glow[reader.view].image[laser][reader.window] = total.glow * reader.gain
            for sampling, g in gathered.items():
                g.add_noise(reader, sampling, laser, total, float(dark[laser]))
    samples = {name: g.combined(mesh, settings.eta, spots, glow) for name, g in gathered.items()}
    first = next(iter(samples.values()))
    statistics = SampleStatistics(
        images=images,
        corrupt=tuple(lost),
        saturated_pixels=saturated,
        spots=len(plan.spots),
        spots_too_oblique=int((spots.transmitted == 0).sum()),
        entries_in_highlight=masked // max(len(gathered), 1),
        coverage=float(np.isfinite(first.values).mean()),
    )
    return samples, statistics


def highlights(
    spots: Spots, calibration: Calibration, plan: Plan, mesh: trimesh.Trimesh, limit_deg: float
) -> dict[tuple[int, int], I64]:
    """(view, spot) -> the vertices inside the beam, wherever the camera is near the beam's mirror direction."""
    out = {}
    reach = spots.beam_radius + float(mesh.edges_unique_length.mean())
    for view in range(plan.views):
        towards = calibration.view_camera(view).position - spots.position
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        half = towards - spots.direction
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        close = (half * spots.normal).sum(axis=1) > np.cos(np.deg2rad(limit_deg))
        for spot in plan.spots_at(plan.angle_of(view)):
            if close[spot]:
                out[view, spot] = np.flatnonzero(np.linalg.norm(mesh.vertices - spots.position[spot], axis=1) < reach)
    return out


def select_lasers(samples: Samples, lasers: I64) -> Samples:
    """The samples of some of the lasers."""
    return samples.with_readings(
        values=samples.values[lasers],
        dark_variance=samples.dark_variance[lasers],
        noise_per_signal=samples.noise_per_signal[lasers],
        glow=tuple(replace(g, image=g.image[lasers], included=g.included[lasers]) for g in samples.glow),
    )
