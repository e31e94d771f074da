"""Programs that use an emulated rig and are ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from rig_fakes import SCENE, quick
from supervisor_fakes import end_supervisors, supervisors_of
from twin_fakes import RIG

from disco_twin.emulation.bench import FLOOD_LINE, LAMP_LINE
from disco_twin.emulation.emulated_rig import Emulation
from disco_twin.emulation.rig_file_of import rig_file_of
from disco_twin.emulation.serve import Server
from disco_twin.scene.rig_schema import TwinRigConfig

FLOOD, LAMP, GATE = 1 << FLOOD_LINE, 1 << LAMP_LINE, 0b1


ONE = TwinRigConfig(cameras=(RIG.cameras[0],))


ONE_LASER = TwinRigConfig(cameras=ONE.cameras, lasers=ONE.lasers[:1])


ONE_LASERS_SCENE = (
    SCENE.replace("[0.99, 0.99, 0.99]", "[0.99]").replace(
        "[[rig.cameras]]", "[[rig.lasers]]\nwavelength_nm = 635.0\n[[rig.cameras]]"
    )
    + '[[relight.lights]]\nkind = "uniform"\ncolour = [1.0]\n'
)


PROGRAM = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import hw.devices.mm_ard
hw.devices.mm_ard.BOOT_S = 0.05
import disco_twin.run.simulate
from disco_twin.emulation.twin_rig import TwinRig
from twin_fakes import Glow
disco_twin.run.simulate.twin_rig = lambda experiment, _: TwinRig(experiment.scene.rig, Glow(), 5)
sys.argv[0] = "disco-twin"
from disco_twin.cli.start import main
main()
"""


STARTED: list[int] = []  # programs of the test that runs


Bench = tuple[Emulation, Server, Path]


@pytest.fixture
def devices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """The devices, their server, and a rig file of the board and one laser."""
    emulated = quick(monkeypatch)
    (tmp_path / "ports").mkdir()
    with Server(emulated.cables, tmp_path / "ports") as server:
        urls = server.urls
        (tmp_path / "rig.toml").write_text(rig_file_of(ONE_LASER, {name: urls[name] for name in ("laser0", "board")}))
        (tmp_path / "scene.toml").write_text(ONE_LASERS_SCENE)
        yield emulated, server, tmp_path / "rig.toml"
        end_supervisors()
        while STARTED:
            for supervisor in supervisors_of(STARTED.pop()):  # of a laser that never came back: ten minutes
                with suppress(ProcessLookupError):
                    os.kill(supervisor, signal.SIGKILL)


def at_pattern(emulated: Emulation, wanted: Callable[[int], bool], action: Callable[[], None]) -> None:
    """Do something once, as soon as the board's lines are so, and before it answers."""
    set_pattern, done = emulated.bench.board.set_pattern, []

    def watched(pattern: int) -> None:
        set_pattern(pattern)
        if wanted(pattern) and not done:
            done.append(pattern)
            action()

    emulated.bench.board.set_pattern = watched  # type: ignore[method-assign]


def started(words: list[str]) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", PROGRAM, *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    STARTED.append(process.pid)
    return process


def said(err: str) -> str:
    """Its last line; before it may come a warning of a driver that had to wait on a busy machine."""
    assert "Traceback" not in err, err
    return err.splitlines()[-1]
