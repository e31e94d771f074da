"""The rig file: which device hangs on which port, what is wired to what, and the limits of every axis.

The scene describes the rig (geometry, wavelengths); the rig file names the hardware; `hw.rig.rig_rules` reads it and
checks it. `port = "emulated"` puts an emulated device in the place of a real one, and a camera of the kind `simulated`
sees what the emulated and real devices light: any mixture works.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PrivateAttr

from hw.base.config import Strict, load_toml
from hw.camera.bracket import Bracket
from hw.devices.mm_ard import LINES, PINS, STEPS
from hw.record import Sensor

EMULATED = "emulated"
RIG_FILE = "a rig file (docs/lab.md, section 3, shows one; `disco-twin rig emulate` writes one)"
PROJECTOR_STEPS = STEPS  # of the board's converters
DARK_COUNTS = 8  # of the photodiode's 1023, with every gate shut

Positive = Annotated[float, Field(gt=0)]
Response = Annotated[float, Field(ge=1, le=1e18)]  # within what a record may state (hw.record)
TtlLine = Annotated[int, Field(ge=0, le=LINES - 1)]
Step = Annotated[int, Field(ge=0, lt=PROJECTOR_STEPS)]
PRINTABLE = r"^[^\x00-\x1f\x7f]*$"  # no control characters


def _text(most: int, description: str) -> Any:
    return Field(min_length=1, max_length=most, pattern=PRINTABLE, description=description)


Port = Annotated[
    str, _text(200, "a path as in /dev/serial/by-id/..., or `emulated`; at most 200 characters, no control characters")
]
Address = Annotated[str, _text(200, "an IP address as in 192.168.1.20, or the serial number of a USB3 camera")]
Name = Annotated[str, _text(64, "1 to 64 characters, no control characters")]


class LaserDevice(Strict):
    """One laser with its gate and its photodiode; in the order of the scene's lasers."""

    kind: Literal["omicron"]
    port: Port
    wavelength_nm: Annotated[float, Field(ge=300, le=1100)]
    power_mw: Annotated[float, Field(gt=0, le=500)]
    baud: Literal[57600, 500000] = 500000
    gate_line: TtlLine  # the board's TTL line that opens the gate
    photodiode_pin: Annotated[int, Field(ge=0, le=PINS - 1)]
    watts_per_count: Positive  # of laser power on the object, per count of the photodiode
    photodiode_limits: tuple[Positive, Positive] = (0.5, 1.5)  # shares of the power; outside, the image is refused

    @property
    def title(self) -> str:
        """What errors call it."""
        return f"laser {self.wavelength_nm:g} nm"


class BoardDevice(Strict):
    """Mirrors, gates, floodlight and photodiode amplifier. Limits keep the beam on the table."""

    kind: Literal["mm-ard"]
    port: Port
    floodlight_line: TtlLine
    limits_u: tuple[Step, Step] = (0, PROJECTOR_STEPS - 1)
    limits_v: tuple[Step, Step] = (0, PROJECTOR_STEPS - 1)
    centre: tuple[Step, Step] = (PROJECTOR_STEPS // 2, PROJECTOR_STEPS // 2)  # where the mirrors stand at first


class Axis(Strict):
    """A turntable: its own angle is `zero_deg + direction * angle of the rig`."""

    port: Port
    zero_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    direction: Literal[1, -1] = 1
    reach_s: Annotated[float, Field(gt=0, le=600)] = 20.0  # a move that takes longer has failed


class ZaberDevice(Axis):
    """A Zaber rotary stage, ASCII protocol."""

    kind: Literal["zaber"]
    microsteps_per_deg: Annotated[float, Field(ge=1, le=1e6)]
    device: Annotated[int, Field(ge=1, le=99)] = 1
    axis: Annotated[int, Field(ge=1, le=9)] = 1


class ElliptecDevice(Axis):
    """A Thorlabs ELL14 or ELL18."""

    kind: Literal["elliptec"]
    address: Annotated[int, Field(ge=0, le=15)] = 0


class GenicamDevice(Strict):
    """A GenICam camera; `name` is the scene's. address: IP (GigE Vision) or serial number (USB3 Vision)."""

    kind: Literal["genicam"]
    name: Name
    address: Address
    serial: Name | None = None  # refuse another camera at this address
    pixel_format: Annotated[
        str, Field(pattern=r"^Mono(10|12|14|16)[A-Za-z0-9]*$", description="Mono10, Mono12, Mono14, Mono16, or packed")
    ] = "Mono12"


class SimulatedCamera(Strict):
    """The scene's camera of this name, simulated: needs the renderer."""

    kind: Literal["simulated"]
    name: Name


class SensorDevice(Strict):
    """The sensor that all GenICam cameras share. Its exposures: longest_exposure_s * 2^-k, k in `exponents`."""

    longest_exposure_s: Annotated[float, Field(ge=1e-6, le=10)]
    exponents: Annotated[tuple[Annotated[int, Field(ge=0, le=23)], ...], Field(min_length=1)] = tuple(range(12))
    bits: Annotated[int, Field(ge=8, le=16)] = 12
    saturation_dn: Annotated[int, Field(ge=1, le=65535)]  # linear below this
    black_dn: Annotated[float, Field(ge=0, le=65535)]
    black_tolerance_dn: Annotated[float, Field(gt=0, le=65535)] = 2.0
    gain_e_per_dn: Annotated[float, Field(ge=1e-6, le=1e6)]
    read_noise_e: Annotated[float, Field(ge=0, le=1e6)]
    dark_e_per_s: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    responsivity: tuple[Response, ...]  # electrons/s per pixel for 1 W/(mm^2 sr), one a laser

    def bracket(self) -> Bracket:
        """The exposures."""
        return Bracket(self.longest_exposure_s, self.exponents, self.bits, self.saturation_dn)

    def sensor(self) -> Sensor:
        """The sensor as the pipeline uses it."""
        return Sensor(
            longest_exposure_s=self.longest_exposure_s,
            steps=self.exponents[-1] + 1,
            bits=self.bits,
            gain_e_per_dn=self.gain_e_per_dn,
            read_noise_e=self.read_noise_e,
            dark_e_per_s=self.dark_e_per_s,
            offset_dn=self.black_dn,
            responsivity=self.responsivity,
        )


class MeterDevice(Strict):
    """A calibrated power meter in the beam, for the self-test alone."""

    kind: Literal["ophir"]
    port: Port


class DevicesFile(Strict):
    """Every device of a rig."""

    format_version: Literal[1]
    lasers: Annotated[tuple[LaserDevice, ...], Field(min_length=1, max_length=3)]
    board: BoardDevice
    turntable: Annotated[ZaberDevice | ElliptecDevice, Field(discriminator="kind")]
    cameras: Annotated[
        tuple[Annotated[GenicamDevice | SimulatedCamera, Field(discriminator="kind")], ...], Field(min_length=1)
    ]
    sensor: SensorDevice | None = None
    power_meter: MeterDevice | None = None
    warm_up_s: Annotated[float, Field(ge=0, le=3600)] = 60.0  # from emission to the first image
    power_tolerance: Annotated[float, Field(gt=0, le=0.5)] = 0.1  # laser's own reading against power_mw

    _path: Path | None = PrivateAttr(None)

    @property
    def path(self) -> Path | None:
        """The file itself, for messages."""
        return self._path

    @property
    def lamp_line(self) -> int:
        """The warning lamp's TTL line: the highest that nothing else uses (at most four others are in use)."""
        used = {laser.gate_line for laser in self.lasers} | {self.board.floodlight_line}
        return max(line for line in range(LINES) if line not in used)

    @classmethod
    def load(cls, path: Path) -> DevicesFile:
        """Read a file; `hw.rig.rig_rules` then compares its keys with each other.

        Raises: InputError for what is no rig file.
        """
        rig = load_toml(path, cls, RIG_FILE, {"object": "a scene", "rig": "a scene"})
        rig._path = path
        return rig

    def ports(self) -> dict[str, str]:
        """Key in the file -> serial port."""
        named = {f"lasers[{i}].port": laser.port for i, laser in enumerate(self.lasers)}
        named |= {"board.port": self.board.port, "turntable.port": self.turntable.port}
        return named | ({} if self.power_meter is None else {"power_meter.port": self.power_meter.port})

    @property
    def all_emulated(self) -> bool:
        """Whether no device with a port is real."""
        return all(port == EMULATED for port in self.ports().values())

    @property
    def real_lasers(self) -> bool:
        """Whether light can leave a real laser."""
        return any(laser.port != EMULATED for laser in self.lasers)

    @property
    def simulated_cameras(self) -> bool:
        """Whether the renderer is needed."""
        return any(camera.kind == "simulated" for camera in self.cameras)
