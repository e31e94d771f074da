"""The faults of 2004 that act on light: laser power over time, speckle. Each has its switch in `[rig.faults]`.

Geometry's faults are in `disco_twin.faults.actual_rig`, the lens's flare in `disco_twin.camera.lens`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.random import SFC64, Generator, SeedSequence
from numpy.typing import NDArray

from disco_twin.scene.rig_schema import FaultsConfig
from pipeline.geometry.nominal_rig import LaserConfig

RED_FROM_NM, GREEN_FROM_NM = 590.0, 500.0
# Missing share at power-on, time constant in s: stable after about a minute (thesis fig. 4.6).
RED_WARM_UP = (0.3, 20.0)
SOLID_STATE_WARM_UP = (0.7, 3.0)
BLUE_NOISE_RMS, BLUE_NOISE_HZ, BLUE_NOISE_TONES = 0.03, (0.02, 7.0), 64
MODE_HOP_S, MODE_HOP_STEP = 250.0, 0.06  # green jumps once, 250 s after power-on
SPECKLE_CONTRAST = 0.05  # standard deviation / mean per pixel; 2.5 um grains under 11 um pixels, depolarised, averaged


class Stream(IntEnum):
    """The twin's streams of random numbers below the seed of a run."""

    SENSOR = 1
    PHOTODIODE = 2
    SPECKLE = 3
    LASER = 4
    DEVIATION = 5
    MIRRORS = 6
    TARGETS = 7
    SCANNER = 8


def generator(seed: int, stream: Stream, *address: int) -> Generator:
    """Random numbers that depend on their address (non-negative integers) alone, not on what was drawn before."""
    return Generator(SFC64(SeedSequence(seed, spawn_key=(int(stream), *address))))


@dataclass(frozen=True)
class LaserPower:
    """The power of each laser as a function of the time since power-on."""

    lasers: Sequence[LaserConfig]
    faults: FaultsConfig
    seed: int

    def watts(self, laser: int, time_s: float) -> float:
        """Power on the object in watts; constant without faults."""
        config = self.lasers[laser]
        wavelength, factor = config.wavelength_nm, 1.0
        if self.faults.warm_up:
            missing, constant = RED_WARM_UP if wavelength >= RED_FROM_NM else SOLID_STATE_WARM_UP
            factor *= 1.0 - missing * np.exp(-time_s / constant)
        if self.faults.mode_hop and GREEN_FROM_NM <= wavelength < RED_FROM_NM and time_s >= MODE_HOP_S:
            factor *= 1.0 + MODE_HOP_STEP
        if self.faults.blue_noise and wavelength < GREEN_FROM_NM:
            factor *= max(0.0, 1.0 + BLUE_NOISE_RMS * self._noise(laser, time_s))
        return float(config.power_mw * 1e-3 * factor)

    def _noise(self, laser: int, time_s: float) -> float:
        """Tones of seeded frequency and phase, unit variance over time: noise that can be asked for at any time."""
        rng = generator(self.seed, Stream.LASER, laser)
        low, high = np.log(BLUE_NOISE_HZ)
        hertz = np.exp(rng.uniform(low, high, BLUE_NOISE_TONES))
        phase = rng.uniform(0, 2 * np.pi, BLUE_NOISE_TONES)
        return float(np.sqrt(2.0 / BLUE_NOISE_TONES) * np.sin(2 * np.pi * hertz * time_s + phase).sum())


def speckle(shape: tuple[int, ...], rng: Generator) -> NDArray[np.float32]:
    """Factors of mean 1: the sum of 1/contrast^2 independent, fully developed patterns is gamma distributed."""
    order = SPECKLE_CONTRAST**-2
    return (rng.standard_gamma(order, shape) / order).astype(np.float32)
