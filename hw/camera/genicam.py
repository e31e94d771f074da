"""A GenICam camera with a linear Mono sensor, bracketed into the record of the Lars III.

`GenicamCamera` is the camera of `hw.interface`; it makes brackets, retries and refuses, and reaches the device through
a `Grabber`: five methods that any GenTL client can offer. `hw.camera.viva_grabber` has the one that ships.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from hw.base.arrays import U16
from hw.base.errors import DiscoError, InputError
from hw.camera.bracket import Bracket
from hw.record import RawImage

log = logging.getLogger(__name__)


ATTEMPTS = 4  # frames that may be lost in a row before the camera is given up
SLACK_S = 1.0  # a frame that has not arrived this long after its exposure is lost
TOLERANCE = 1e-3  # of an exposure: half of it is the error of the radiance between two steps of the bracket


class CameraError(DiscoError):
    """A camera that does not deliver, or is not the camera it should be."""


class FrameLost(Exception):
    """One frame did not arrive, or not whole. Taking it again is right."""


@dataclass(frozen=True)
class CameraFrame:
    """One frame as the camera sent it, complete.

    pixels: (height, width) uint16 digital numbers, padding and packing removed; timestamp_s: the camera's own clock;
    exposure_s: the frame's own record of its exposure, None where the camera does not send it along
    """

    pixels: U16
    timestamp_s: float
    exposure_s: float | None = None


class Grabber(Protocol):
    """A GenTL client, as far as the camera needs it. Failures are `CameraError`, except where noted."""

    def identity(self) -> str:
        """Vendor, model and serial number of the camera."""

    def set_exposure(self, seconds: float) -> float:
        """Ask for an exposure; the seconds that the camera reads back."""

    def grab(self, timeout_s: float) -> CameraFrame:
        """Trigger one exposure and return its frame. Raises `FrameLost` where a new attempt may help."""

    def restart(self) -> None:
        """Throw away all frames under way, so that none of them answers the next trigger."""

    def close(self) -> None:
        """Give the camera back. Never raises."""


@dataclass
class GenicamCamera:
    """`hw.interface.Camera` over a grabber. shape: (height, width) that the rig expects."""

    name: str
    grabber: Grabber
    bracket: Bracket
    shape: tuple[int, int]
    lost: int = 0  # frames taken again since the camera was opened
    _last_s: float = field(default=-np.inf, repr=False)

    def check(self) -> None:
        """Refuse a camera that cannot make the bracket's exposures, before a capture depends on it.

        Raises: InputError.
        """
        for exponent in self.bracket.exponents:
            self._set_exposure(exponent)

    def expose(self) -> RawImage:
        """The bracket, from the longest exposure down, as far as some pixel is still saturated. Raises: CameraError."""
        return self.bracket.merge((exponent, self._frame(exponent)) for exponent in self.bracket.exponents)

    def black_level(self, frames: int = 4) -> tuple[float, float]:
        """Mean and standard deviation, in digital numbers, of the shortest exposure; the rig is dark meanwhile."""
        exponent = self.bracket.exponents[-1]
        stack = np.stack([self._frame(exponent) for _ in range(frames)]).astype(np.float64)
        return float(stack.mean()), float(stack.std(axis=0, ddof=1).mean())

    def close(self) -> None:
        """Give the camera back."""
        self.grabber.close()

    def _set_exposure(self, exponent: int) -> float:
        wanted = self.bracket.exposure_s(exponent)
        made = self.grabber.set_exposure(wanted)
        if not abs(made - wanted) <= TOLERANCE * wanted:
            problem = f"camera {self.name} exposes for {made * 1e6:.2f} us instead of {wanted * 1e6:.2f} us"
            remedy = "make the shortest exposure a multiple of the camera's step, or use fewer exponents"
            key, longest = "sensor.longest_exposure_s", self.bracket.longest_exposure_s
            raise InputError(problem, key=key, value=longest, remedy=remedy)
        return wanted

    def _frame(self, exponent: int) -> U16:
        """(height, width) of one exposure; a frame that is lost is taken again, and never stored in part."""
        wanted = self._set_exposure(exponent)
        reason = ""
        for attempt in range(ATTEMPTS):
            try:
                return self._checked(self.grabber.grab(wanted + SLACK_S), wanted)
            except FrameLost as loss:
                reason = str(loss)
                self.lost += 1
                log.warning("camera %s: frame lost (%s), attempt %d of %d", self.name, reason, attempt + 1, ATTEMPTS)
                self.grabber.restart()
                self._last_s = -np.inf  # some cameras count time from the start of the acquisition
                self._set_exposure(exponent)
        remedy = "check cable and network card (jumbo frames, receive buffers), then repeat the command"
        raise self._error(f": {ATTEMPTS} frames in a row were lost ({reason})", remedy)

    def _error(self, problem: str, remedy: str) -> CameraError:
        return CameraError(f"camera {self.name}{problem}. Remedy: {remedy}")

    def _checked(self, frame: CameraFrame, wanted_s: float) -> U16:
        if frame.exposure_s is not None and not abs(frame.exposure_s - wanted_s) <= TOLERANCE * wanted_s:
            raise FrameLost(f"it was exposed for {frame.exposure_s * 1e6:.1f} us, not {wanted_s * 1e6:.1f} us")
        if frame.timestamp_s <= self._last_s:
            problem = f": its clock went back from {self._last_s:.6f} s to {frame.timestamp_s:.6f} s: it was restarted"
            raise self._error(problem, "repeat the command")
        self._last_s = frame.timestamp_s
        if frame.pixels.dtype != np.uint16 or frame.pixels.shape != self.shape:
            sent, expected = f"{frame.pixels.shape} {frame.pixels.dtype}", f"{self.shape} uint16 (height, width)"
            remedy = "width, height and pixel_format in the rig file"
            raise self._error(f" sends {sent}, the rig expects {expected}", remedy)
        highest = int(frame.pixels.max())
        if highest > self.bracket.full_scale_dn:
            top, bits = self.bracket.full_scale_dn, self.bracket.bits
            raise self._error(f" sends {highest}, above the {top} of {bits} bits", "bits in the rig file")
        return frame.pixels
