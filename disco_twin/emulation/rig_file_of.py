"""The rig file of a scene's emulated rig."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping

from disco_twin.emulation.bench import FLOOD_LINE
from disco_twin.emulation.twin_rig import watts_per_count
from disco_twin.firmware.zaber import MICROSTEPS_PER_DEG
from hw.base.config import check
from hw.rig.rig_file import EMULATED, DevicesFile
from pipeline.geometry.nominal_rig import RigConfig

LASER = """[[lasers]]
kind = "omicron"
port = "{port}"
wavelength_nm = {laser.wavelength_nm}
power_mw = {laser.power_mw}
gate_line = {index}
photodiode_pin = {index}
watts_per_count = {watts_per_count!r}
photodiode_limits = [0.1, 1.5] # the twin's lasers start cold
"""
BOARD = """[board]
kind = "mm-ard"
port = "{port}"
floodlight_line = {FLOOD_LINE}
"""
TURNTABLE = """[turntable]
kind = "zaber"
port = "{port}"
microsteps_per_deg = {MICROSTEPS_PER_DEG!r}
"""


def rig_file_of(scene: RigConfig, ports: Mapping[str, str]) -> str:
    """The rig file of a scene's emulated rig, as TOML; `ports` by the device's name, `emulated` where none is given."""
    parts = ["format_version = 1\nwarm_up_s = 0.0 # emulated lasers have nothing to warm up\n"]
    for index, laser in enumerate(scene.lasers):
        port, scale = ports.get(f"laser{index}", EMULATED), watts_per_count(laser)
        parts.append(LASER.format(port=port, laser=laser, index=index, watts_per_count=scale))
    parts.append(BOARD.format(port=ports.get("board", EMULATED), FLOOD_LINE=FLOOD_LINE))
    port = ports.get("turntable", EMULATED)
    parts.append(TURNTABLE.format(port=port, MICROSTEPS_PER_DEG=MICROSTEPS_PER_DEG))
    parts += [f'[[cameras]]\nkind = "simulated"\nname = "{camera.name}"\n' for camera in scene.cameras]
    return "\n".join(parts)


def emulated_rig_file(scene: RigConfig) -> DevicesFile:
    """The same, with every device emulated, as it is read."""
    return check(tomllib.loads(rig_file_of(scene, {})), DevicesFile, "rig.toml")
