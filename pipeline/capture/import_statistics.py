"""What all frames together say about their sensor, against what capture.toml states of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hw.base.arrays import F64, I64, U16
from hw.base.errors import InputError
from hw.record import Sensor
from pipeline.capture.import_brackets import CLIPPED, OFFSET_DN, Pair

SIGMAS = 8.0  # of the read noise: no pixel is that far from its mean
DARK_SHARE = 0.02  # of a frame's pixels that may lie below the black level for other reasons (dead ones)
PEAK = 10.0  # times as frequent as the numbers below it is the one that a sensor clips at
WINDOWS = (1, 8)  # widths in DN of such a peak: exact, or blurred by the noise of a full well
DISTINCT = 32  # numbers that must occur before their spacing tells anything
MOSAIC = 1.3  # times the light, that no grey camera's odd pixels have of its even ones over all frames
BENT = 0.08  # by which the power law of a bracket may differ from a straight line
PAIRS = 4  # brackets, to say so


@dataclass
class FrameStatistics:
    """Collected frame by frame. counts: (65536,) how often every digital number occurs; dark: frames that lie below
    the black level by more than noise, of `frames`; lowest_dn: the darkest percent there; phases: (2, 2) light of the
    pixels in even and odd rows and columns.
    """

    sensor: Sensor
    saturation_dn: int
    counts: I64 = field(default_factory=lambda: np.zeros(1 << 16, np.int64))
    frames: int = 0
    dark: int = 0
    lowest_dn: list[float] = field(default_factory=list)
    pairs: list[Pair] = field(default_factory=list)
    phases: F64 = field(default_factory=lambda: np.zeros((2, 2)))

    @property
    def noise_dn(self) -> float:
        """Read noise with that of the digits."""
        return float(np.hypot(self.sensor.read_noise_e / self.sensor.gain_e_per_dn, 12**-0.5))

    @property
    def floor_dn(self) -> float:
        """Below it lies no pixel of this sensor, whatever it shows."""
        return self.sensor.offset_dn - SIGMAS * self.noise_dn - OFFSET_DN

    def add(self, pixels: U16) -> None:
        """One frame."""
        found = np.bincount(pixels.ravel(), minlength=1 << 16)
        self.counts += found
        self.frames += 1
        self.phases += [[float(pixels[i::2, j::2].mean()) - self.sensor.offset_dn for j in (0, 1)] for i in (0, 1)]
        low = np.arange(1 << 16) < self.floor_dn
        if found[low].sum() > DARK_SHARE * pixels.size:
            self.dark += 1
            self.lowest_dn.append(float(np.percentile(pixels, 1)))

    def require_description(self, file: Path) -> None:
        """Raises: InputError where the numbers of all frames contradict capture.toml."""
        self._require_spacing(file)
        self._require_grey(file)
        self._require_saturation(file)
        self._require_straight(file)
        self._require_black(file)

    def _require_spacing(self, file: Path) -> None:
        values = np.flatnonzero(self.counts)
        step = int(np.diff(values).min()) if len(values) >= DISTINCT else 1
        if step < 2:
            return
        shift = f"divide the frames' numbers by {step}" if np.all(values % step == 0) else "take the raw numbers"
        raise InputError(
            f"no two numbers in the frames are closer than {step}: they were multiplied, as by a camera that fills the "
            "upper bits of its words", file=file, key="sensor.bits", value=self.sensor.bits,
            remedy=f"{shift}, and state bits, offset_dn, saturation_dn and gain_e_per_dn of those",
        )  # fmt: skip

    def _require_black(self, file: Path) -> None:
        offset, told = self.sensor.offset_dn, [p for p in self.pairs if p.black_dn is not None]
        if told and not self.sensor.response:
            black = float(np.median([p.black_dn for p in told]))
            error = float(np.median([p.black_error_dn for p in told]))
            if abs(black - offset) > error:
                raise InputError(
                    f"the brackets' exposures meet at {round(black)} DN, {abs(black - offset):.0f} "
                    f"{'below' if black < offset else 'above'} it: that is the black level of these frames", file=file,
                    key="sensor.offset_dn", value=offset,
                    remedy="state that level, or switch off what the camera's software does to it",
                )  # fmt: skip
        if self.dark > self.frames / 2:
            low = float(np.median(self.lowest_dn))
            raise InputError(
                f"dark pixels of the frames lie at {low:.0f} DN, {offset - low:.0f} below it: the black level of these "
                "frames is another", file=file, key="sensor.offset_dn", value=offset,
                remedy="state their level, or switch off what the camera's software does to it",
            )  # fmt: skip

    def _require_grey(self, file: Path) -> None:
        least, most = float(self.phases.min()), float(self.phases.max())
        if most < MOSAIC * max(least, 0.0) + OFFSET_DN * self.frames:
            return
        raise InputError(
            f"every second pixel of the frames shows {most / max(least, 1.0):.2g} times the light of its neighbours: "
            "they come from a colour camera's mosaic", file=file, key="rig.cameras",
            remedy="take one colour's pixels alone, every second row and column, and state their size and pitch",
        )  # fmt: skip

    def _require_saturation(self, file: Path) -> None:
        top = int(np.flatnonzero(self.counts).max(initial=0))
        if top >= self.saturation_dn or top <= self.sensor.offset_dn:
            return
        for width in WINDOWS:
            peak, below = _windows(self.counts, top, width)
            if peak >= CLIPPED * np.sqrt(width) and peak > PEAK * (below.mean() + 1):
                raise InputError(
                    f"{peak} pixels of the frames show {top} DN{'' if width == 1 else ' or hardly less'} and none "
                    "more: there the sensor saturates", file=file, key="saturation_dn", value=self.saturation_dn,
                    remedy=f"state {top - width + 1} or less",
                )  # fmt: skip

    def _require_straight(self, file: Path) -> None:
        bent = [p.exponent for p in self.pairs if p.exponent is not None]
        if self.sensor.response or len(bent) < PAIRS or abs(np.median(bent) - 1) <= BENT:
            return
        gamma = 1 / float(np.median(bent))
        raise InputError(
            f"the frames' numbers rise with the exposure as with a gamma of {gamma:.2f}: the camera is not linear",
            file=file, key="sensor.response", remedy="switch the camera's gamma off, or state its response",
        )  # fmt: skip


def _windows(counts: I64, top: int, width: int) -> tuple[int, NDArray[np.int64]]:
    """Pixels in the window that ends at `top`, and in each of the 8 windows below it."""
    low = max(0, top + 1 - 9 * width)
    below = counts[low : top + 1 - width]
    whole = len(below) // width * width
    return int(counts[top + 1 - width : top + 1].sum()), below[len(below) - whole :].reshape(-1, width).sum(axis=1)


def incomplete(pixels: U16, before: U16 | None, statistics: FrameStatistics) -> str | None:
    """Why a frame is no complete picture; None if nothing speaks against it. before: the frame before it in the table.

    A buffer that was read too early holds a run of one number that no sensor with noise gives, or the rest of the frame
    before it. One that was blown up shows every row or column twice.
    """
    height, width = pixels.shape
    flat = pixels.ravel()
    starts = np.flatnonzero(np.concatenate([[True], flat[1:] != flat[:-1]]))
    lengths = np.diff(np.append(starts, flat.size))
    values = flat[starts].astype(float)
    near_black = np.abs(values - statistics.sensor.offset_dn) <= SIGMAS * statistics.noise_dn + OFFSET_DN
    odd = (lengths >= max(width, 64)) & ~near_black & (values < statistics.saturation_dn) & (values < flat.max())
    if odd.any():
        k = int(np.argmax(np.where(odd, lengths, 0)))
        row = int(starts[k]) // width
        return f"shows {int(values[k])} in {int(lengths[k])} pixels on end from row {row} on"
    for name, lines in (("row", pixels), ("column", pixels.T)):
        even = lines[: len(lines) // 2 * 2]
        if np.ptp(pixels) > 4 * (1 + statistics.noise_dn) and np.array_equal(even[::2], even[1::2]):
            return f"shows every {name} twice"
    if before is not None and before.shape == pixels.shape and not np.array_equal(before, pixels):
        last = pixels[-1]
        varies = np.ptp(last) > 4 and len(np.unique(last)) > 4
        if varies and np.array_equal(last, before[-1]):
            same = int(np.argmin((pixels == before).all(axis=1)[::-1])) or height
            return f"ends with {same} rows of the frame before it"
    return None


def content_key(pixels: U16) -> bytes | None:
    """What two frames of one content have in common; None for a frame that shows one number alone."""
    return None if np.ptp(pixels) == 0 else blake2b(np.ascontiguousarray(pixels).tobytes(), digest_size=16).digest()
