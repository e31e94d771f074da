"""A scene: one TOML file that states what is simulated, captured, reconstructed and relit."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from disco_twin.scene.object_schema import ObjectConfig, ScanConfig
from disco_twin.scene.rig_schema import FaultsConfig, TwinRigConfig
from disco_twin.scene.shape_schema import Direction
from hw.base.config import Strict, load_toml
from pipeline.geometry.nominal_rig import CameraConfig, Point
from pipeline.reconstruct.settings import ReconstructConfig
from pipeline.relight.lights import Colour, Light, shipped_lights

Count = Annotated[int, Field(ge=1, lt=2**32)]  # photons are numbered in 32 bits
Profile = Literal["full", "small"]
FILE_NAME, LONGEST_NAME = r"[a-z0-9_-]+", 32  # as of cameras
DEFAULT_WALKS = 200_000
SHIPPED_NM = (635.0, 532.0, 476.0)  # of the colours of shipped lights
SPOT_BUDGETS = ("walks_per_spot", "spot_seconds", "spot_noise")


class SimulationConfig(Strict):
    """How much light is traced; the noise goes with the inverse square root of the walks, their time with its inverse
    square.

    What a spot may cost is stated as a time or as a noise, one of three keys: the time of so many plain walks
    (`walks_per_spot`; `DEFAULT_WALKS` where no key is stated), seconds of one core, as `disco-twin plan` predicts them
    (`spot_seconds`), or the simulation's deviation over the camera's in the median pixel (`spot_noise`).
    """

    walks_per_spot: Count | None = None
    spot_seconds: Annotated[float, Field(ge=1e-3, le=1e6)] | None = None
    spot_noise: Annotated[float, Field(ge=0.1, le=1e4)] | None = None
    # Of that time, for walks whose photons are split towards the dark: faint light is less noisy, the spot more so.
    split_share: Annotated[float, Field(ge=0, le=0.9)] = 0.0
    truth_columns: Count = 24  # scan vertices from which the true exitance per irradiance is computed
    truth_walks: Count = 500_000  # a column, with weight windows
    reference_noise: Annotated[float, Field(ge=0.002, le=1)] = 0.03  # rms over a reference image, of its rms light

    @model_validator(mode="after")
    def _one_budget(self) -> SimulationConfig:
        stated = [key for key in SPOT_BUDGETS if getattr(self, key) is not None]
        if len(stated) > 1:
            raise ValueError(f"{' and '.join(stated)} each say what a spot costs; keep one of them")
        return self


class Neck(Strict):
    """A plane in the object frame that parts head and body: light that crosses it is scored (thesis, figure 6.6)."""

    through_mm: Point
    normal: Direction = (0.0, 0.0, 1.0)


class RelightConfig(Strict):
    """What the model is tried on: held-out cameras in the object frame, lights, and where the object has one its neck.

    A light is a table or the name of a shipped one (those are placed by the first view); left out: all shipped ones.
    """

    views: Annotated[tuple[CameraConfig, ...], Field(min_length=2, max_length=16)]
    lights: Annotated[tuple[Light, ...], Field(validate_default=True)] = ()
    neck: Neck | None = None

    @field_validator("lights", mode="before")
    @classmethod
    def _by_name(cls, lights: Any, info: ValidationInfo) -> Any:
        if "views" not in info.data or not isinstance(lights, list | tuple):
            return lights  # reported as such
        shipped = {light.name: light for light in shipped_lights(info.data["views"][0].position_mm)}
        unknown = [light for light in lights if isinstance(light, str) and light not in shipped]
        if unknown:
            raise ValueError(f"unknown light {unknown[0]!r}, shipped are {', '.join(shipped)}")
        return tuple(shipped[light] if isinstance(light, str) else light for light in lights or shipped)

    @field_validator("lights")
    @classmethod
    def _names_of_files(cls, lights: tuple[Light, ...]) -> tuple[Light, ...]:
        for light in lights:
            if len(light.name) > LONGEST_NAME or not re.fullmatch(FILE_NAME, light.name):
                shown = light.name if len(light.name) <= LONGEST_NAME else f"{light.name[:LONGEST_NAME]}..."
                raise ValueError(
                    f"the name {shown!r} is to be part of a file's name, as a camera's is (allowed: 1 to "
                    f"{LONGEST_NAME} small letters, digits, _ and -)"
                )
        return lights


class Scene(Strict):
    """Everything about one run."""

    format_version: Literal[1]
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$", max_length=64)]
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    object: ObjectConfig
    scan: ScanConfig = ScanConfig()
    rig: TwinRigConfig
    simulation: SimulationConfig = SimulationConfig()
    reconstruct: ReconstructConfig = ReconstructConfig()
    relight: RelightConfig

    @model_validator(mode="after")
    def _lights_for_lasers(self) -> Scene:
        """Lights whose colour the scene does not state have one for these lasers, however many they are."""
        lights = tuple(_for_lasers(light, self) for light in self.relight.lights)
        object.__setattr__(self, "relight", self.relight.model_copy(update={"lights": lights}))
        return self

    @model_validator(mode="after")
    def _consistent(self) -> Scene:
        lasers = len(self.rig.lasers)
        for key, values in self.object.per_wavelength():
            if len(values) not in (1, lasers):
                raise ValueError(f"object.{key} has {len(values)} values for {lasers} lasers")
        for light in self.relight.lights:
            if any(len(colour) != lasers for colour in _colours(light)):
                raise ValueError(f"relight.lights: the colour of {light.name!r} needs {lasers} values, one a laser")
        for what, names in (
            ("relight.lights", [light.name for light in self.relight.lights]),
            ("relight.views and rig.cameras", [c.name for c in (*self.rig.cameras, *self.relight.views)]),
        ):
            if len(set(names)) < len(names):
                raise ValueError(f"{what}: names must be distinct, found {', '.join(names)}")
        if self.scan.vertices is not None and self.simulation.truth_columns > self.scan.vertices / 2:
            columns = self.simulation.truth_columns
            raise ValueError(f"simulation.truth_columns = {columns}: more than half of scan.vertices")
        return self


def _for_lasers(light: Light, scene: Scene) -> Light:
    """A light, with the shipped colour at the nearest of the shipped wavelengths where its own is not stated."""
    wavelengths = [laser.wavelength_nm for laser in scene.rig.lasers]
    if len(wavelengths) == len(SHIPPED_NM):
        return light
    nearest = [min(range(len(SHIPPED_NM)), key=lambda k: abs(SHIPPED_NM[k] - nm)) for nm in wavelengths]

    def picked(colour: Colour) -> Colour:
        return tuple(colour[k] for k in nearest)

    if light.kind != "environment":
        stated = "colour" in light.model_fields_set
        return light if stated else light.model_copy(update={"colour": picked(light.colour)})
    if light in shipped_lights(scene.relight.views[0].position_mm):
        lobes = tuple(lobe.model_copy(update={"radiance": picked(lobe.radiance)}) for lobe in light.lobes)
        return light.model_copy(update={"constant": picked(light.constant), "lobes": lobes})
    stated = "constant" in light.model_fields_set
    return light if stated else light.model_copy(update={"constant": picked(light.constant)})


def _colours(light: Light) -> list[Colour]:
    return [light.constant, *(lobe.radiance for lobe in light.lobes)] if light.kind == "environment" else [light.colour]


def load_scene(path: str | Path, profile: Profile = "full", faults: bool | None = None) -> Scene:
    """Read a scene; file names inside it are relative to its folder. `small` shrinks it, see `shrink`.

    faults: every fault of the rig is on or off, whatever the scene states. Raises: InputError.
    """
    scene = load_toml(path, Scene, others={"board": "a rig file", "turntable": "a rig file"})
    if faults is not None:
        all_of_them = FaultsConfig(**dict.fromkeys(FaultsConfig.model_fields, faults))
        scene = scene.model_copy(update={"rig": scene.rig.model_copy(update={"faults": all_of_them})})
    return shrink(scene) if profile == "small" else scene


def shrink(scene: Scene) -> Scene:
    """The profile `small`: the same scene with a quarter of the pixels and of the spots and a tenth of the walks.

    At least 20 spots, 16 pixels, 4 columns of truth and 1000 walks are left; geometry and media stay as they are.
    """

    def half(camera: CameraConfig) -> CameraConfig:
        width, height = max(16, camera.width // 2), max(16, camera.height // 2)
        pitch = camera.pixel_pitch_um * camera.width / width
        return camera.model_copy(update={"width": width, "height": height, "pixel_pitch_um": pitch})

    walks = scene.simulation
    stated = (walks.walks_per_spot, walks.spot_seconds, walks.spot_noise)
    plain = DEFAULT_WALKS if stated == (None, None, None) else walks.walks_per_spot
    simulation = SimulationConfig(
        split_share=walks.split_share,
        walks_per_spot=None if plain is None else max(1000, plain // 10),
        spot_seconds=None if walks.spot_seconds is None else max(1e-3, walks.spot_seconds / 10),
        spot_noise=None if walks.spot_noise is None else min(1e4, walks.spot_noise * math.sqrt(10)),
        truth_columns=min(walks.truth_columns, max(4, walks.truth_columns // 4)),
        truth_walks=max(1000, walks.truth_walks // 10),
        reference_noise=max(walks.reference_noise, min(0.1, walks.reference_noise * math.sqrt(10))),
    )
    cameras = tuple(half(camera) for camera in scene.rig.cameras)
    spots = min(scene.rig.spots, max(20, scene.rig.spots // 4))
    rig = scene.rig.model_copy(update={"cameras": cameras, "spots": spots})
    relight = scene.relight.model_copy(update={"views": tuple(half(view) for view in scene.relight.views)})
    return scene.model_copy(update={"rig": rig, "relight": relight, "simulation": simulation})
