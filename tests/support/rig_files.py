"""Rig files."""

from __future__ import annotations

from pathlib import Path

from twin_fakes import RIG

from disco_twin.emulation.rig_file_of import rig_file_of

CAMERAS = """
[[cameras]]
kind = "genicam"
name = "front"
address = "10.0.0.9"

[[cameras]]
kind = "genicam"
name = "back"
address = "10.0.0.8"

[sensor]
longest_exposure_s = 0.02
exponents = [0, 2, 4]
saturation_dn = 3900
black_dn = 64.0
gain_e_per_dn = 2.0
read_noise_e = 5.0
responsivity = [1e12, 1e12, 1e12]
"""


def rig_file(folder: Path, *changes: tuple[str, str], cameras: str | None = None, **ports: str) -> Path:
    content = rig_file_of(RIG, ports)
    if cameras is not None:
        content = content[: content.index("[[cameras]]")] + cameras
    for old, new in changes:
        assert old in content, old
        content = content.replace(old, new, 1)
    path = folder / "rig.toml"
    path.write_text(content, encoding="utf-8")
    return path
