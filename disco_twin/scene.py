"""A scene: one TOML file that says what is simulated, captured, reconstructed and relit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from disco_twin.object.schema import ObjectConfig
from pipeline.config import Strict, load_toml
from pipeline.reconstruct.settings import ReconstructConfig
from pipeline.relight.lights import Light
from pipeline.rig import CameraConfig, RigConfig

Count = Annotated[int, Field(ge=1, le=10**10)]


class ScanConfig(Strict):
    """The mesh that the pipeline is given: about `vertices` vertices, or (left out) the object's own mesh."""

    vertices: Annotated[int, Field(ge=50, le=1_000_000)] | None = None


class SimulationConfig(Strict):
    """How much light is traced. Fewer walks: faster, noisier (noise goes with the square root)."""

    walks_per_spot: Count = 200_000
    truth_columns: Count = 24  # scan vertices whose R_d column is computed as ground truth
    truth_walks: Count = 2_000_000  # per column
    reference_walks: Count = 20_000_000  # per light and half


class RelightConfig(Strict):
    """What the model is tried on: lights, and held-out cameras in the object frame."""

    lights: tuple[Light, ...] = ()
    views: Annotated[tuple[CameraConfig, ...], Field(min_length=1, max_length=16)]


class Scene(Strict):
    """Everything about one run."""

    format_version: Literal[1] = 1
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$", max_length=64)]
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    object: ObjectConfig
    scan: ScanConfig = ScanConfig()
    rig: RigConfig
    simulation: SimulationConfig = SimulationConfig()
    reconstruct: ReconstructConfig = ReconstructConfig()
    relight: RelightConfig


def load_scene(path: str | Path) -> Scene:
    """Read a scene; file names inside it are relative to its folder."""
    return load_toml(path, Scene)
