"""A scene file that is in order."""

from __future__ import annotations

CAMERA = "position_mm = [450.0, 0.0, 50.0]\nwidth = 192\nheight = 124\n"


GOOD = f"""
format_version = 1
name = "good"
[object.shape]
kind = "sphere"
[object.medium.base]
kind = "homogeneous"
sigma_t_per_mm = 1.6
albedo = [0.9, 0.8, 0.7]
[[object.medium.features]]
kind = "hollow"
radius_mm = 3.0
[scan]
vertices = 642
[[rig.cameras]]
name = "a"
{CAMERA}
[[relight.views]]
name = "b"
{CAMERA}
[[relight.views]]
name = "c"
{CAMERA}
"""
