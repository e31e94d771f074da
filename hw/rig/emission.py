"""Light in a rig: the one sequence by which lasers begin to emit, and what is required of their light.

The rig uses it for all of its lasers, the self-test for one after the other.
"""

from __future__ import annotations

from collections.abc import Mapping

from hw.base.clock import Clock
from hw.base.errors import DeviceFault
from hw.devices.mm_ard import ADC_TOP
from hw.interface import LaserReading
from hw.rig.drivers import LaserDriver
from hw.rig.rig_file import DARK_COUNTS, DevicesFile, LaserDevice
from hw.rig.verified_board import VerifiedBoard
from hw.safety.ports.protocol_supervised import require_supervisor
from hw.safety.signals import raise_if_interrupted

ASKED_EVERY_S = 0.5  # whether the supervisor is there, while lasers warm up


def begin_emission(
    clock: Clock, file: DevicesFile, board: VerifiedBoard, lasers: Mapping[int, LaserDriver]
) -> list[LaserReading]:
    """Light the warning lamp, then arm the lasers and wait for their emission, behind shut gates; what they read then.

    lasers: driver by the laser's number in the file

    Raises: DeviceError where a laser does not emit what it should, or its light is not kept back.
    """
    board.switch(file.lamp_line, True)
    for index, laser in lasers.items():
        laser.arm(file.lasers[index].power_mw)
        laser.emit()
    warm_up(clock, file.warm_up_s)
    return check_lasers(file, board, lasers)


def warm_up(clock: Clock, seconds: float) -> None:
    """Wait while lasers that emit become steady, and end at once where they were made dark, or the program is to."""
    left = seconds
    while left > 0:
        clock.sleep(min(left, ASKED_EVERY_S))
        left -= ASKED_EVERY_S
        raise_if_interrupted()
        require_supervisor()


def check_lasers(file: DevicesFile, board: VerifiedBoard, lasers: Mapping[int, LaserDriver]) -> list[LaserReading]:
    """Every laser's own reading, and its photodiode's in the dark: all gates are shut.

    Raises: DeviceFault where either is not what it should be.
    """
    readings = []
    for index, laser in lasers.items():
        device = file.lasers[index]
        own_mw = laser.require_power(file.power_tolerance)
        remedy = f"see that the gate of {laser.name} shuts, shade the photodiode, or correct its offset"
        counts = require_darkness(board.counts(device.photodiode_pin), device, "with every gate shut", remedy)
        readings.append(LaserReading(1e-3 * device.power_mw, 1e-3 * own_mw, counts * device.watts_per_count))
    return readings


def require_darkness(counts: int, device: LaserDevice, when: str, remedy: str) -> int:
    """The photodiode's counts, refused where they are not dark. when: why they should be. Raises: DeviceFault."""
    if counts > DARK_COUNTS:
        problem = f"reads {counts} counts {when} (allowed: {DARK_COUNTS})"
        raise DeviceFault(f"pin {device.photodiode_pin}", f"the photodiode of {device.title}", problem, remedy)
    return counts


def require_light(counts: int, device: LaserDevice, own_mw: float | None = None) -> float:
    """Watts behind the open gate, by the photodiode's counts.

    own_mw: the laser's own reading, where it is to be compared with watts_per_count

    Raises: DeviceFault where they are not within the photodiode's limits, or the converter is at its top.
    """
    watts, (low, high) = counts * device.watts_per_count, device.photodiode_limits
    if counts < ADC_TOP and low <= watts / (device.power_mw * 1e-3) <= high:
        return watts
    problem = f"gives {1e3 * watts:.2f} mW ({counts} counts) at the photodiode instead of {device.power_mw:g} mW"
    if counts >= ADC_TOP:
        problem += " (the converter is at its top)"
        remedy = "lower the gain of its amplifier, then measure watts_per_count anew"
    else:
        problem += f" (allowed: {low * device.power_mw:g} to {high * device.power_mw:g} mW)"
        remedy = "check the laser's interlock, the gate, gate_line, photodiode_pin and the amplifier's gain"
        if own_mw is not None and counts > DARK_COUNTS:
            fitting = 1e-3 * own_mw / counts
            remedy += f"; if they are right, watts_per_count is near {fitting:.3g} by the laser's own reading"
    raise DeviceFault(f"pin {device.photodiode_pin}", device.title, problem, remedy)
