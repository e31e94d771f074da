"""The Silicon Vision Lars III with a Lametar 2.8/25 lens (thesis 4.3) as an ordered list of named steps.

Published are 768 x 496 pixels, 30 frames/s, about 120 dB and exposure steps in powers of two; wells, noise and quantum
efficiency are those of comparable CMOS sensors. With the default configuration a pixel reaches from 1.3e-10 (signal =
read noise) to 8e-4 W/(mm^2 sr).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from disco_twin.camera import sensor as steps
from disco_twin.camera.lens import Glare, vignetting
from disco_twin.scene.rig_schema import TwinRigConfig
from hw.record import RawImage, Sensor
from pipeline.geometry.camera import PinholeCamera
from pipeline.geometry.nominal_rig import RigConfig

PIXEL_MM = 0.011
F_NUMBER = 4.0  # at 2.8 the peak of a 10 mW spot on a white object would saturate at the shortest exposure
PLANCK_TIMES_C = 1.98644586e-25  # J m
QUANTUM_EFFICIENCY = ((300.0, 0.05), (476.0, 0.36), (532.0, 0.42), (635.0, 0.40), (800.0, 0.25), (1100.0, 0.01))
DECISION_SHARE = 7.0 / 16.0  # of the full scale: twice that leaves 1/8 as room for noise, so only the brightest clip


def responsivity(wavelength_nm: float) -> float:
    """Electrons per second per pixel for 1 W/(mm^2 sr): pixel area x pi/(4 N^2) x quantum efficiency / photon energy.

    Pixels are those of the Lars III whatever a scene's pitch: a coarser image stands for the mean over its pixels.
    """
    watts = PIXEL_MM**2 * np.pi / (4.0 * F_NUMBER**2)
    wavelengths, efficiencies = zip(*QUANTUM_EFFICIENCY, strict=True)
    efficiency = float(np.interp(wavelength_nm, wavelengths, efficiencies))
    return float(watts * efficiency * wavelength_nm * 1e-9 / PLANCK_TIMES_C)


def lars3_sensor(rig: RigConfig) -> Sensor:
    """What the pipeline may know of the sensor. Lasers above 10 mW find the lens stopped down in proportion."""
    config = rig.sensor
    full_scale_dn = 2**config.bits - 1 - config.offset_dn
    stop = max(1.0, max(laser.power_mw for laser in rig.lasers) / 10.0)
    return Sensor(
        longest_exposure_s=config.longest_exposure_s,
        steps=config.steps,
        bits=config.bits,
        gain_e_per_dn=config.full_well_e / full_scale_dn,
        read_noise_e=config.read_noise_e,
        dark_e_per_s=config.dark_e_per_s,
        offset_dn=config.offset_dn,
        responsivity=tuple(responsivity(laser.wavelength_nm) / stop for laser in rig.lasers),
        decision_e=DECISION_SHARE * config.full_well_e,
    )


@dataclass(frozen=True)
class Step:
    """One step of the camera: name, unit of what it returns, and the function of (input, generator)."""

    name: str
    unit: str
    apply: Callable[[Any, Generator], Any]


@dataclass(frozen=True)
class Lars3:
    """One camera. vignetting: (height, width) float32 transmission; glare: None where the lens has no flare.

    curved: whether digital numbers are compressed
    """

    sensor: Sensor
    vignetting: NDArray[np.float32]
    glare: Glare | None = None
    curved: bool = False

    @classmethod
    def of(cls, rig: TwinRigConfig, camera: PinholeCamera) -> Lars3:
        """The twin's camera behind the lens of `camera`."""
        glare = Glare.of(camera.height, camera.width) if rig.faults.flare else None
        return cls(lars3_sensor(rig), vignetting(camera), glare, rig.sensor.response == "curved")

    def steps(self, laser: int, exponent: int | None = None) -> tuple[Step, ...]:
        """The way from radiance to digital numbers for light of one laser, in order; exponent: given to all pixels."""
        sensor = self.sensor
        glare = self.glare
        return (
            *(() if glare is None else (Step("glare", "W/(mm^2 sr)", lambda x, _: glare(x)),)),
            Step("vignetting", "W/(mm^2 sr)", lambda x, _: x * self.vignetting),
            Step("photoelectrons", "e/s", lambda x, _: steps.photoelectrons(x, sensor, laser)),
            Step("dark signal", "e/s", lambda x, _: steps.add_dark(x, sensor)),
            Step("shot noise and exposure decision", "exponent, e", lambda x, rng: steps.integrate(x, sensor, rng))
            if exponent is None
            else Step("shot noise", "exponent, e", lambda x, rng: steps.integrate_for(x, sensor, exponent, rng)),
            Step("read noise", "exponent, e", lambda x, rng: steps.add_read_noise(x, sensor, rng)),
            *((Step("compression", "exponent, e", lambda x, _: steps.compress(x, sensor)),) if self.curved else ()),
            Step("quantisation", "exponent, DN", lambda x, _: steps.quantise(x, sensor)),
        )

    def expose(
        self, radiance: NDArray[np.float32], laser: int, rng: Generator, exponent: int | None = None
    ) -> RawImage:
        """(height, width) radiance in W/(mm^2 sr) on the lens's axis side -> the raw record."""
        image: Any = radiance
        for step in self.steps(laser, exponent):
            image = step.apply(image, rng)
        assert isinstance(image, RawImage)
        return image
