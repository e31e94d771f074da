"""Cables that are pulled while light is let out: what the user reads is one line a device, in words."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
import serial
from rig_fakes import SCENE, quick
from rig_programs import ONE, PROGRAM, at_pattern
from supervisor_fakes import supervisors_of

from disco_twin.emulation.bench import LAMP_LINE
from disco_twin.emulation.rig_file_of import rig_file_of
from disco_twin.emulation.serve import Server
from hw.base.clock import WallClock
from hw.base.errors import Unplugged
from hw.serial.link import Link

RAW = re.compile(r"Errno|multiple access|write failed|returned no data|supervised://")


def test_all_cables_pulled_is_a_line_a_device_and_the_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Laser 0 lets light out when every cable goes. The lasers are told to go off when they are back."""
    emulated = quick(monkeypatch)
    (tmp_path / "ports").mkdir()
    (tmp_path / "scene.toml").write_text(SCENE)
    pulled: list[str] = []
    with Server(emulated.cables, tmp_path / "ports") as server:
        (tmp_path / "rig.toml").write_text(rig_file_of(ONE, server.urls))
        scene, out_folder, rig = (str(tmp_path / name) for name in ("scene.toml", "out", "rig.toml"))
        words = ["capture", scene, "--out", out_folder, "--rig", rig, "--arm"]
        with (tmp_path / "said").open("w") as sink:  # its supervisor lives longer, and keeps its outlet
            process = subprocess.Popen([sys.executable, "-c", PROGRAM, *words], stdout=sink, stderr=sink)
        at_pattern(emulated, lambda pattern: pattern == 1 << LAMP_LINE | 1, lambda: pulled.append("now"))
        try:
            while process.poll() is None and not pulled:
                time.sleep(0.01)
            for name in list(server.urls):
                server.unplug(name)
            process.wait(timeout=40)
        finally:
            process.kill()
            for name in emulated.cables:
                server.plug(name)  # the supervisor finds board and lasers again, and ends
            end = time.monotonic() + 10.0
            while supervisors_of(process.pid) and time.monotonic() < end:
                time.sleep(0.05)
    out = (tmp_path / "said").read_text()
    said = [line for line in out.splitlines() if "ports/" in line or "disco-twin:" in line]
    assert process.returncode == 2 and pulled, out
    assert not RAW.search(out), out
    for name in ("laser0", "laser1", "laser2"):
        assert sum(name in line for line in said[:-1]) == 1, out
        assert any(name in line and "MAY BE ON" in line and "interlock" in line for line in said), out
    assert sum("board" in line for line in said[:-1]) <= 1 and len(said) <= 5, out
    assert said[-1].startswith(f"disco-twin: {rig}: ") and "Remedy" in said[-1], out


@pytest.mark.parametrize(
    "raw", ["[Errno 5] Input/output error", "device reports readiness to read but returned no data"]
)
def test_a_lost_port_is_said_in_words(monkeypatch: pytest.MonkeyPatch, raw: str) -> None:
    class Port:
        in_waiting = 1

        def read(self, size: int) -> bytes:
            raise serial.SerialException(raw)

        def write(self, data: bytes) -> int:
            raise serial.SerialException(f"write failed: {raw}")

    monkeypatch.setattr("serial.serial_for_url", lambda url, **options: Port())
    link = Link("/dev/ttyUSB3", 9600, "mirror board", WallClock())
    with pytest.raises(Unplugged) as first:
        link.read(0.1)
    with pytest.raises(Unplugged) as second:
        link.write(b"a")
    assert "its cable was pulled, or it lost power" in str(first.value)
    assert not RAW.search(str(first.value)) and not RAW.search(str(second.value))
    assert not first.value.known and second.value.known
