"""Has the rig moved while the capture was interrupted? A stored spot of every laser is shot again and compared.

Compared are laser power (photodiode), radiance per watt and where the light lies in the image. Anything beyond the
tolerances is refused with its figures: images before and after would not belong to one object in one place. Where the
object is too dark in a laser's light for its image to tell anything, its power still is compared.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from hw.base.arrays import F64
from hw.base.errors import DiscoError
from hw.interface import Rig, gate_open
from hw.record import RawImage, Sensor, to_radiance
from pipeline.plan.plan import ImageAddress
from pipeline.stream.stream import CorruptImage, StreamReader

log = logging.getLogger(__name__)


LOOK_BACK = 30  # stored images, among which the brightest of a laser is its reference
LOOK_FURTHER = 300  # images of a laser, spread over all before these, of which the last one that is bright serves
BRIGHT_SIGMA = 50.0  # light of all pixels together, in its standard deviations: below, nothing can be verified
SHIFT_PX = 0.5
POWER_SHARE = 0.2
RADIANCE_SHARE = 0.1
PATTERN_SHARE = 0.15  # rms of the difference that neither shift nor brightness explain, of the rms of the image


class RigMoved(DiscoError):
    """The rig is not what it was when the last images were taken."""


@dataclass(frozen=True)
class SpotComparison:
    """Now against then. power, radiance: ratios (radiance per watt); shift_px: (right, down); pattern: share of rms."""

    power: float
    radiance: float
    shift_px: tuple[float, float]
    pattern: float

    @property
    def moved(self) -> bool:
        """Whether any figure is beyond its tolerance."""
        return (
            not abs(self.power - 1) <= POWER_SHARE
            or not abs(self.radiance - 1) <= RADIANCE_SHARE
            or not np.hypot(*self.shift_px) <= SHIFT_PX
            or not self.pattern <= PATTERN_SHARE
        )

    def __str__(self) -> str:
        right, down = self.shift_px
        return (
            f"laser power {100 * (self.power - 1):+.1f} % (allowed: {100 * POWER_SHARE:g}), "
            f"radiance per watt {100 * (self.radiance - 1):+.1f} % ({100 * RADIANCE_SHARE:g}), "
            f"moved by {right:+.2f}, {down:+.2f} px ({SHIFT_PX:g}), "
            f"pattern differs by {100 * self.pattern:.1f} % ({100 * PATTERN_SHARE:g})"
        )


@dataclass(frozen=True)
class _Reference:
    """A stored spot. radiance: per watt, and its variance, (H, W) each; significance: in standard deviations."""

    address: ImageAddress
    radiance: F64
    variance: F64
    significance: float


def require_unmoved(rig: Rig, stored: StreamReader, sensor: Sensor) -> list[SpotComparison]:
    """Shoot a stored spot of every laser again. Raises: RigMoved where one differs, or all are too dim to compare.

    A laser whose spots are all dim among bright ones is compared by its power alone: that mirrors and object are where
    they were is told by the others. A laser without a stored spot has nothing to be compared with. Leaves turntable,
    mirrors and clock at the last reference, gates shut.
    """
    of_laser: list[list[int]] = [[] for _ in range(stored.plan.lasers)]
    for index in range(len(stored) - 1, -1, -1):
        address = stored.plan.address(index)
        if address.kind == "spot":
            of_laser[address.laser].append(index)
    found = {laser: _reference(stored, sensor, indices) for laser, indices in enumerate(of_laser) if indices}
    dim = [laser for laser, reference in found.items() if reference is None]
    if dim and len(dim) == len(found):
        raise RigMoved(
            "no stored spot is bright enough to tell whether the rig has moved since the capture was interrupted. "
            "Remedy: start a new capture in another folder"
        )
    for laser in dim:
        _require_power(rig, stored, of_laser[laser])
    return [_require_same(rig, stored, sensor, reference) for reference in found.values() if reference is not None]


def _require_power(rig: Rig, stored: StreamReader, indices: Sequence[int]) -> None:
    """The power of a laser whose images tell nothing, against that of its last image. indices: the last one first."""
    address, then = stored.plan.address(indices[0]), stored.meta(indices[0]).photodiode_w
    _, now = _shoot(rig, stored, address)
    what = f"laser power of {address}: {1e3 * now:.3g} mW, was {1e3 * then:.3g} mW (allowed: {100 * POWER_SHARE:g} %)"
    if not then > 0 or not abs(now / then - 1) <= POWER_SHARE:
        raise RigMoved(
            f"the rig has changed since image {indices[0]}: {what}, and its images are too dim to tell more. Remedy: "
            "see to laser, gate and fibre, or start a new capture in another folder"
        )
    log.warning("no stored spot of laser %d is bright enough to compare images: %s", address.laser, what)


def _shoot(rig: Rig, stored: StreamReader, address: ImageAddress) -> tuple[RawImage, float]:
    """Take a stored spot once more; its image, and the photodiode's watts."""
    plan, meta, aim = stored.plan, stored.meta(address), stored.plan.spots[address.spot]
    rig.turntable.move(meta.angle_rad)
    rig.projector.move(aim.u, aim.v)
    rig.resume_at(meta.time_s)  # a simulated laser's drift is a function of time: like is compared with like
    with gate_open(rig.lasers[address.laser]):
        raw = rig.cameras[plan.camera_of(address.view)].expose()
        power = rig.photodiode.read()
    if not power > 0:
        raise RigMoved(f"no laser light: the photodiode reads {power:g} W where it read {meta.photodiode_w:g} W. "
                       "Remedy: see to the laser, its gate and fibre, and repeat the same command")  # fmt: skip
    return raw, power


def _require_same(rig: Rig, stored: StreamReader, sensor: Sensor, then: _Reference) -> SpotComparison:
    """Shoot one reference again."""
    plan, address, meta = stored.plan, then.address, stored.meta(then.address)
    raw, power = _shoot(rig, stored, address)
    again = to_radiance(raw, sensor, address.laser)
    now, noise = again.radiance / power, again.variance / power**2
    result = compare(then.radiance, np.asarray(now, float), then.variance + noise, power / meta.photodiode_w)
    log.info("reference (%s): %s", address, result)
    if result.moved:
        raise RigMoved(
            f"the rig has changed since image {plan.index(address)} ({address}): {result}. Remedy: put it back, or "
            "start a new capture in another folder"
        )
    return result


def _reference(stored: StreamReader, sensor: Sensor, indices: Sequence[int]) -> _Reference | None:
    """The brightest of a laser's latest images or, if they are all dim, an earlier one. indices: the last one first."""
    near = [index for index in indices if index >= len(stored) - LOOK_BACK]
    looked = [image for index in near if (image := _bright(stored, sensor, index)) is not None]
    if looked:
        return max(looked, key=lambda image: image.significance)
    before = indices[len(near) :]
    spread = before[:: 1 + len(before) // LOOK_FURTHER]
    return next((image for index in spread if (image := _bright(stored, sensor, index)) is not None), None)


def _bright(stored: StreamReader, sensor: Sensor, index: int) -> _Reference | None:
    """A stored spot, unless it is damaged or too dim."""
    address = stored.plan.address(index)
    try:
        watts = stored.meta(index).photodiode_w
        if not watts > 0:
            return None
        image = to_radiance(stored.read(index), sensor, address.laser)
    except CorruptImage as error:
        log.warning("%s", error)
        return None
    radiance, variance = image.radiance.astype(float) / watts, image.variance.astype(float) / watts**2
    significance = float(radiance.sum() / np.sqrt(variance.sum()))
    return _Reference(address, radiance, variance, significance) if significance > BRIGHT_SIGMA else None


def compare(then: F64, now: F64, variance: F64, power: float) -> SpotComparison:
    """(H, W) radiances per watt, variance of their difference, ratio of the powers.

    Shift and brightness together by Gauss-Newton on now(x) = g then(x - d) (Lucas and Kanade 1981), both images a
    little smoothed, from the whole pixels at which their correlation is highest.
    """
    smooth = [np.asarray(ndimage.gaussian_filter(image, 1.0)) for image in (then, now)]
    shift = _whole_pixels(*smooth)
    gain = 1.0
    for _ in range(8):
        moved = ndimage.shift(smooth[0], shift, order=3, mode="nearest")
        columns = [-gain * np.asarray(g) for g in np.gradient(moved)] + [moved]
        matrix = np.stack([c.ravel() for c in columns], axis=1)
        step, *_ = np.linalg.lstsq(matrix, (smooth[1] - gain * moved).ravel(), rcond=None)
        shift, gain = shift + step[:2], gain + float(step[2])
        if np.abs(step[:2]).max() < 1e-3:
            break
    rest = now - gain * ndimage.shift(then, shift, order=3, mode="nearest")
    unexplained = max(0.0, float((rest**2).mean() - variance.mean()))
    pattern = float(np.sqrt(unexplained / max(float((now**2).mean()), 1e-300)))
    return SpotComparison(power, gain, (float(shift[1]), float(shift[0])), pattern)


def _whole_pixels(then: F64, now: F64) -> F64:
    """(2,) rows and columns by which `now` is moved, to a pixel: the highest circular correlation."""
    spectrum = np.fft.rfft2(now - now.mean()) * np.conj(np.fft.rfft2(then - then.mean()))
    correlation = np.fft.irfft2(spectrum, s=then.shape)
    peak = np.array(np.unravel_index(int(np.argmax(correlation)), then.shape), float)
    size = np.array(then.shape, float)
    return np.where(peak > size / 2, peak - size, peak)
