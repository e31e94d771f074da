"""Emulated rigs, their scenes and rig files, and programs that use them."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from twin_fakes import RIG, Glow

from disco_twin.emulation.emulated_rig import Emulation
from disco_twin.emulation.served_rig import emulated_devices
from disco_twin.emulation.twin_rig import TwinRig

SCENE = """
format_version = 1
name = "bench"
[object.shape]
kind = "sphere"
radius_mm = 15.0
[object.medium.base]
kind = "homogeneous"
sigma_t_per_mm = 1.3
albedo = [0.99, 0.99, 0.99]
[rig]
spots = 6
turntable_angles_deg = [0.0]
[[rig.cameras]]
name = "front"
position_mm = [450.0, 60.0, 100.0]
width = 48
height = 31
pixel_pitch_um = 176.0
[[relight.views]]
name = "left"
position_mm = [150.0, 400.0, 110.0]
[[relight.views]]
name = "right"
position_mm = [-375.0, -190.0, 95.0]
"""


def quick(monkeypatch: pytest.MonkeyPatch) -> Emulation:
    """Emulated devices in real time without their waits, as `served` will serve them."""
    monkeypatch.setattr("disco_twin.firmware.omicron.EMISSION_S", 0.05)
    monkeypatch.setattr("disco_twin.firmware.turning.SPEED_DEG_S", 720.0)
    monkeypatch.setattr("hw.devices.mm_ard.BOOT_S", 0.05)
    monkeypatch.setattr("disco_twin.firmware.mm_ard.BOOT_S", 0.02)
    devices = emulated_devices(RIG, 3)
    monkeypatch.setattr("disco_twin.emulation.served_rig.emulated_devices", lambda scene, seed: devices)
    return devices


def emulation() -> Emulation:
    return Emulation(TwinRig(RIG, Glow(), seed=5))


def at_image(emulated: Emulation, number: int, action: Callable[[], None]) -> None:
    """Do something just before an exposure."""
    count = 0
    for camera in emulated.bench.cameras:
        expose = camera.expose

        def counted(expose: Callable[[], object] = expose) -> object:
            nonlocal count
            count += 1
            if count == number:
                action()
            return expose()

        camera.expose = counted  # type: ignore[method-assign,assignment]


def reset(emulated: Emulation) -> None:
    """The board forgets its lines and its mirrors, and listens again at once."""
    emulated.bench.board.set_pattern(0)
    for galvo in emulated.bench.board.galvos:
        galvo.aim(0, emulated.clock.now())


def at_message(emulated: Emulation, wanted: Callable[[bytes, int], bool], action: Callable[[], None]) -> None:
    """Do something, and lose the message, when the board is sent a certain one."""
    line, number = emulated.cables["board"], 0
    receive = line.receive

    def received(data: bytes) -> None:
        nonlocal number
        number += data[:1] == b"\x03"  # mirrors: two messages an aim
        if wanted(data, number):
            wanted_once.append(True)
            if len(wanted_once) == 1:
                action()
                return
        receive(data)

    wanted_once: list[bool] = []
    line.receive = received  # type: ignore[method-assign]
