"""From raw records to readings at the vertices, as fast as records are decoded.

What is constant per view is computed once, and images of one view and laser are then read together (thesis 5.1): a
record becomes radiance by one look-up per pixel, and the readings contain the lens's vignetting. Every vertex is read
from every image; noise is not: it is summed over the images, since only its mean over the spots is wanted.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse

from hw.base.arrays import F32, F64, I64
from hw.base.errors import DiscoError
from hw.base.resources import usable_cores
from hw.record import RawImage, Sensor, to_radiance
from pipeline.calibrate.calibration import Calibration
from pipeline.geometry.pixel_footprints import window
from pipeline.plan.plan import ImageAddress
from pipeline.reconstruct.samples.image_operators import ImageOperator
from pipeline.stream.stream import CorruptImage, StreamReader

log = logging.getLogger(__name__)

MIN_SHARE = 0.5  # of a vertex's hat that a camera must see
TOGETHER = 32  # images whose sums one thread keeps in single precision
# (1, -2, 1) x (1, -2, 1) answers white noise of variance s^2 with 36 s^2, and a slope not at all (Immerkaer 1996).
SECOND_DIFFERENCES = 36.0


@dataclass(frozen=True)
class ViewReader:
    """What the images of one view have in common.

    window: (rows, columns) of the image that show the object
    rows: per sampling, (n,) the vertices that are seen well enough
    operators: per sampling, (n, h * w) float32, radiance in the window without the lens's gain -> their readings
    gain: (h, w) by which the lens makes the radiance appear too low
    """

    view: int
    window: tuple[slice, slice]
    rows: Mapping[str, I64]
    operators: Mapping[str, sparse.csr_array]
    gain: F64

    @classmethod
    def of(
        cls, view: int, calibration: Calibration, mesh: trimesh.Trimesh, readings: Mapping[str, ImageOperator]
    ) -> ViewReader:
        """The reader of a view for each sampling of `readings`."""
        camera = calibration.view_camera(view)
        shown = window(mesh, camera)
        gain = 1.0 / calibration.vignetting(view)[shown]
        inside = np.arange(camera.height * camera.width).reshape(camera.height, camera.width)[shown].ravel()
        lens = sparse.diags_array(gain.ravel())
        rows = {sampling: np.flatnonzero(reading.share > MIN_SHARE) for sampling, reading in readings.items()}
        operators = {
            sampling: _single(reading.operator[rows[sampling]][:, inside] @ lens)
            for sampling, reading in readings.items()
        }
        return cls(view, shown, rows, operators, gain)


@dataclass
class Sums:
    """Sums over images of one view and laser, (h, w) of the window. An image's radiance L counts as scale * L.

    glow: of radiance; noise: of each pixel's noise variance as its 3 x 3 neighbours show it, exact on average;
    shot: of the variance that the camera's model gives
    """

    glow: F64
    noise: F64
    shot: F64

    @classmethod
    def zeros(cls, shape: tuple[int, int], dtype: type[np.floating] = np.float64) -> Sums:
        """No image yet."""
        return cls(*(np.zeros(shape, dtype) for _ in range(3)))

    def add(self, radiance: NDArray[np.floating], variance: NDArray[np.floating]) -> None:
        """One image, scaled; both contiguous.

        Differences are taken along the flat image, in few passes. At the ends of its rows they are not of neighbours,
        and `noise_variance` does not use them.
        """
        self.glow += radiance
        self.shot += variance
        flat, width = radiance.reshape(-1), radiance.shape[1]
        middle = flat[width:-width]
        curved = flat[: -2 * width] + flat[2 * width :]
        curved -= middle
        curved -= middle
        middle = curved[1:-1]
        twice = curved[:-2] + curved[2:]
        twice -= middle
        twice -= middle
        twice *= twice
        self.noise.reshape(-1)[width + 1 : -width - 1] += twice

    def __iadd__(self, other: Sums) -> Sums:
        self.glow += other.glow
        self.noise += other.noise
        self.shot += other.shot
        return self

    def noise_variance(self) -> F64:
        """(h, w) the sum of noise variances. Pixels at the window's border have no neighbours: they take the next's."""
        inner = self.noise[1:-1, 1:-1] / SECOND_DIFFERENCES
        return np.pad(inner, 1, mode="edge") if inner.size else np.zeros_like(self.noise)


@dataclass(frozen=True)
class Batch:
    """Images of one view and laser."""

    reader: ViewReader
    laser: int
    addresses: Sequence[ImageAddress]


@dataclass
class BatchResult:
    """What came of a batch.

    value: per sampling, (n, rows) readings in mm^-2; NaN where an image is lost, saturated or hidden by a highlight
    alone: per sampling, (2, rows) noise and shot variance in mm^-4 of images of which some readings are NaN; `sums`
        holds those of the other images
    scale: (n,) pi / (F_t(w_i) Phi) of each image, times the camera's factor to the photodiode; 0 where it is lost
    saturated: pixels; hidden: readings that a highlight alone has cost
    """

    batch: Batch
    value: dict[str, F32]
    alone: dict[str, F64]
    scale: F64
    sums: Sums
    lost: list[ImageAddress] = field(default_factory=list)
    saturated: int = 0
    hidden: int = 0

    @classmethod
    def of(cls, batch: Batch) -> BatchResult:
        """Nothing read yet."""
        count = len(batch.addresses)
        rows = {sampling: len(vertices) for sampling, vertices in batch.reader.rows.items()}
        return cls(
            batch,
            {sampling: np.full((count, n), np.nan, np.float32) for sampling, n in rows.items()},
            {sampling: np.zeros((2, n)) for sampling, n in rows.items()},
            np.zeros(count),
            Sums.zeros(batch.reader.gain.shape, np.float32),
        )


def _single(matrix: Any) -> sparse.csr_array:
    """The matrix in single precision and with short indices: what is read once per image should be small.

    Its indices are sorted: scipy's abs() sorts them in place, which must not happen while other threads read.
    """
    m = sparse.csr_array(matrix)
    short = m.indices.astype(np.int32), m.indptr.astype(np.int32)
    out = sparse.csr_array((m.data.astype(np.float32), *short), shape=m.shape)
    out.sum_duplicates()
    return out


def look_up(sensor: Sensor, laser: int) -> tuple[F32, F32]:
    """Radiance and variance, each (steps * 2^bits,), of every record that a pixel may hold."""
    shape = (sensor.steps, 1 << sensor.bits)
    exponent, charge = np.indices(shape, np.uint16)
    image = to_radiance(RawImage(exponent.astype(np.uint8), charge), sensor, laser)
    return image.radiance.ravel(), image.variance.ravel()


def resample(
    stream: StreamReader,
    calibration: Calibration,
    readers: Sequence[ViewReader],
    transmitted: F64,
    hidden: Mapping[tuple[int, int], I64],
) -> Iterator[BatchResult]:
    """Read every spot image once, on all cores; the results come in one order always.

    transmitted: (S,) F_t(w_i) of the spots; images of spots where it is 0 are not read
    hidden: (view, spot) -> vertices that are not read, if any
    """
    plan, tables = stream.plan, [look_up(calibration.sensor, laser) for laser in range(stream.plan.lasers)]
    batches = []
    for reader in readers:
        spots = [s for s in plan.spots_at(plan.angle_of(reader.view)) if transmitted[s] > 0]
        for laser in range(plan.lasers):
            for low in range(0, len(spots), TOGETHER):
                some = [ImageAddress(reader.view, "spot", s, laser) for s in spots[low : low + TOGETHER]]
                batches.append(Batch(reader, laser, some))

    def work(batch: Batch) -> BatchResult:
        result, view = BatchResult.of(batch), batch.reader.view
        for i, address in enumerate(batch.addresses):
            raw = _record(stream, address, calibration.sensor)
            if raw is None:
                result.lost.append(address)
                continue
            power = stream.meta(address).photodiode_w
            result.scale[i] = np.pi * calibration.factor(view, batch.laser) / (transmitted[address.spot] * power)
            _read(
                result, i, raw, calibration.sensor, tables[batch.laser], hidden.get((batch.reader.view, address.spot))
            )
        return result

    with ThreadPoolExecutor(usable_cores(), thread_name_prefix="resample") as pool:
        yield from pool.map(work, batches)


def _read(
    result: BatchResult, i: int, raw: RawImage, sensor: Sensor, table: tuple[F32, F32], hidden: I64 | None
) -> None:
    """Read image number i of a batch; every step before the next image, while it is in the cache."""
    reader, scale = result.batch.reader, result.scale[i]
    index = raw.exponent[reader.window].astype(np.min_scalar_type(len(table[0]) - 1))
    index <<= index.dtype.type(sensor.bits)
    index |= raw.charge[reader.window]
    place = index.astype(np.intp)
    # Scaling the tables is less work than scaling the images; all places are in range, as `_record` has seen to.
    radiance = (table[0] * np.float32(scale)).take(place, mode="clip")
    variance = (table[1] * np.float32(scale**2)).take(place, mode="clip")
    for sampling, operator in reader.operators.items():
        result.value[sampling][i] = operator @ radiance.reshape(-1)
    full = None
    if raw.charge.max() >= sensor.saturation_dn:
        result.saturated += int((raw.charge >= sensor.saturation_dn).sum())
        full = (raw.charge[reader.window] >= sensor.saturation_dn).reshape(-1).astype(np.float32)
    if hidden is None and full is None:
        result.sums.add(radiance, variance)
    else:
        own = Sums.zeros(reader.gain.shape)
        own.add(radiance, variance)
        result.sums.glow += radiance
        for sampling in reader.operators:
            _read_in_part(result, i, sampling, own, full, hidden)


def _read_in_part(result: BatchResult, i: int, sampling: str, own: Sums, full: F32 | None, hidden: I64 | None) -> None:
    """Blank the vertices that an image does not show. The noise of the others is kept apart, vertex by vertex: the sums
    over images cannot leave vertices out.
    """
    reader = result.batch.reader
    operator, rows = reader.operators[sampling], reader.rows[sampling]
    touched = np.zeros(len(rows), bool) if full is None else abs(operator) @ full > 0
    masked = np.isin(rows, [] if hidden is None else hidden) & ~touched
    read = np.flatnonzero(~touched & ~masked)
    squared = operator[read].multiply(operator[read])
    result.alone[sampling][:, read] += squared @ own.noise_variance().ravel(), squared @ own.shot.ravel()
    result.value[sampling][i, touched | masked] = np.nan
    result.hidden += int(masked.sum())


def _record(stream: StreamReader, address: ImageAddress, sensor: Sensor) -> RawImage | None:
    """The record, or None with a warning where it is damaged or was taken without light."""
    try:
        raw = stream.read(address)
    except CorruptImage as corrupt:
        log.warning("%s", corrupt)
        return None
    if not stream.meta(address).photodiode_w > 0:
        log.warning("%s: the photodiode saw no light; image left out", address)
        return None
    if raw.exponent.max() >= sensor.steps or raw.charge.max() > sensor.saturation_dn:
        raise DiscoError(
            f"{address}: exponent {raw.exponent.max()}, charge {raw.charge.max()} do not fit the sensor "
            f"({sensor.steps} steps, {sensor.bits} bits). Remedy: use the sensor.json of this capture"
        )
    return raw
