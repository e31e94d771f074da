"""Ctrl-C again and again, a terminal that is closed, a manager that kills: signals come in swarms."""

from __future__ import annotations

import signal
import threading
import time
from pathlib import Path

import pytest
from rig_programs import GATE, LAMP, Bench, at_pattern, devices, said, started

__all__ = ["devices"]  # the fixture


@pytest.mark.parametrize("command", ["selftest", "capture"])
def test_signals_are_obeyed_once_until_the_program_has_ended(devices: Bench, tmp_path: Path, command: str) -> None:
    """Ctrl-C with a gate open; then, every 2 ms until there is nobody to tell, one signal more of every kind.

    Expected: the rig is safe, and the exit status the first signal's.
    """
    emulated, _, rig = devices
    words = ["rig", "selftest", str(rig), "--arm"]
    if command == "capture":
        words = ["capture", str(tmp_path / "scene.toml"), "--out", str(tmp_path / "out"), "--rig", str(rig), "--arm"]
    process, told = started(words), threading.Event()

    def swarm() -> None:
        told.wait(60.0)
        while process.poll() is None:
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                process.send_signal(number)
            time.sleep(0.002)

    def tell() -> None:
        process.send_signal(signal.SIGINT)
        told.set()

    at_pattern(emulated, lambda pattern: pattern == LAMP | GATE, tell)
    thread = threading.Thread(target=swarm, daemon=True)
    thread.start()
    out, err = process.communicate(timeout=60)
    told.set()
    thread.join()
    assert emulated.bench.board.lines == 0 and not any(head.on_since for head in emulated.bench.heads), out + err
    assert process.returncode == 130 and said(err).startswith("disco-twin: stopped: "), (process.returncode, err)
