"""Lasers that emit."""

from __future__ import annotations

from serial_fakes import LaserBench

from hw.devices.omicron import OmicronLaser


def emitting(bench: LaserBench, power_mw: float = 40.0) -> OmicronLaser:
    laser = bench.connect()
    laser.arm(power_mw)
    laser.emit()
    return laser
