"""capture.toml: what somebody states of a capture that was made without our software."""

from __future__ import annotations

import itertools
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from hw.base.config import NearbyFile, Strict
from hw.camera.bracket import Bracket
from hw.record import Sensor
from pipeline.geometry.nominal_rig import RigConfig


class SensorDescription(Strict):
    """[sensor], in the ranges of a rig file; `hw.record.Sensor` says what its fields are."""

    longest_exposure_s: Annotated[float, Field(ge=1e-6, le=10)]
    steps: Annotated[int, Field(ge=1, le=24)]
    bits: Annotated[int, Field(ge=8, le=16)]
    gain_e_per_dn: Annotated[float, Field(ge=1e-6, le=1e6)]
    read_noise_e: Annotated[float, Field(ge=0, le=1e6)]
    dark_e_per_s: Annotated[float, Field(ge=0, le=1e9)]
    offset_dn: Annotated[float, Field(ge=0, le=65535)]
    responsivity: Annotated[tuple[Annotated[float, Field(ge=1, le=1e18)], ...], Field(min_length=1, max_length=3)]
    decision_e: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    response: Annotated[tuple[Annotated[float, Field(ge=0, le=1)], ...], Field(max_length=65536)] = ()

    @model_validator(mode="after")
    def _rises(self) -> Self:
        rising = all(a < b for a, b in itertools.pairwise(self.response))
        if self.response and not (rising and self.response[0] == 0 and self.response[-1] == 1):
            raise ValueError("response does not rise from 0 to 1: give its values so, or leave it out (linear)")
        return self


class CaptureDescription(Strict):
    """capture.toml."""

    format_version: Literal[1]
    scan: NearbyFile
    saturation_dn: Annotated[int, Field(ge=1, le=65535)]  # linear below this
    sensor: SensorDescription
    rig: RigConfig

    @model_validator(mode="after")
    def _fits_itself(self) -> Self:
        sensor, lasers = self.sensor, len(self.rig.lasers)
        if len(sensor.responsivity) != lasers:
            raise ValueError(
                f"sensor.responsivity has {len(sensor.responsivity)} of the {lasers} values that rig.lasers ask for: "
                "give one for each laser"
            )
        full_scale = (1 << sensor.bits) - 1
        if self.saturation_dn > full_scale:
            raise ValueError(
                f"saturation_dn = {self.saturation_dn} is beyond what sensor.bits = {sensor.bits} can hold (allowed: "
                f"at most {full_scale})"
            )
        if sensor.offset_dn >= self.saturation_dn:
            raise ValueError(
                f"sensor.offset_dn = {sensor.offset_dn:g} is no less than saturation_dn = {self.saturation_dn}: "
                "nothing is left for light"
            )
        return self

    @property
    def known(self) -> Sensor:
        """The sensor as the pipeline is given it."""
        return Sensor(**self.sensor.model_dump())

    @property
    def bracket(self) -> Bracket:
        """The exposures that an image may have."""
        sensor = self.sensor
        return Bracket(sensor.longest_exposure_s, tuple(range(sensor.steps)), sensor.bits, self.saturation_dn)
