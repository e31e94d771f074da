"""`disco-twin rig`: find, test and emulate the devices of a rig file. Needs no renderer."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from disco_twin.cli.names import given
from hw.base.errors import InputError
from hw.safety.signals import interruptible, raise_if_interrupted
from pipeline.capture.loop import Interrupted

if TYPE_CHECKING:
    from hw.rig.rig_file import DevicesFile
    from hw.rig.selftest import DeviceFinding

rig_app = typer.Typer(help="Devices: find them, test them, emulate them.")
console = Console()

LONGEST_S = 1e7  # that devices are emulated: 116 days

RigPath = Annotated[Path, typer.Argument(metavar="RIG.TOML", help="The rig file.", parser=given("RIG.TOML"))]
SceneOption = Annotated[
    Path | None,
    typer.Option("--scene", metavar="SCENE", help="The scene, which has the cameras' sizes.", parser=given("--scene")),
]
ArmOption = Annotated[bool, typer.Option("--arm", help="Let real lasers emit.")]
LogsOption = Annotated[
    Path | None,
    typer.Option(
        "--logs", metavar="DIR", help="Keep every byte to and from the devices there.", parser=given("--logs")
    ),
]


@rig_app.command()
def probe(rig: RigPath, scene: SceneOption = None, logs: LogsOption = None) -> None:
    """Connect to every real device and show what it is. Switches lasers off and shuts gates; nothing moves."""
    from hw.rig.selftest import probe as run_probe

    _show(run_probe(*_loaded(rig, scene, logs), logs))


@rig_app.command()
def selftest(rig: RigPath, scene: SceneOption = None, arm: ArmOption = False, logs: LogsOption = None) -> None:
    """Move, expose and read back every real device. Lasers emit only with --arm."""
    from hw.rig.selftest import selftest as run_selftest

    _show(run_selftest(*_loaded(rig, scene, logs), arm, logs))


@rig_app.command()
def emulate(
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE", help="The scene whose devices are emulated.", parser=given("SCENE"))
    ],
    folder: Annotated[
        Path,
        typer.Option("--ports", metavar="DIR", help="Where the ports and rig.toml appear.", parser=given("--ports")),
    ],
    seconds: Annotated[float, typer.Option(help="How long.")] = 3600.0,
) -> None:
    """Serve the devices of a scene on pseudo-terminals, in real time, and write the rig file that reaches them."""
    from disco_twin.emulation.served_rig import served
    from disco_twin.scene.scene import load_scene

    if not 0.1 <= seconds <= LONGEST_S:
        allowed = f"0.1 to {LONGEST_S:.0f}"
        raise InputError("is no such time", key="--seconds", value=seconds, allowed=allowed, remedy="choose another")
    loaded = load_scene(scene)
    with interruptible():
        try:
            with served(loaded.rig, loaded.seed, folder) as path:
                said = f"devices are served; rig file: {path}   (Ctrl-C ends it)"
                console.print(said, highlight=False, soft_wrap=True)
                raise_if_interrupted()  # a signal while the line was printed may have been swallowed there
                time.sleep(seconds)
        except KeyboardInterrupt:
            console.print("ended")


def _loaded(path: Path, scene: Path | None, logs: Path | None) -> tuple[DevicesFile, dict[str, tuple[int, int]] | None]:
    """The rig file, and the sizes of the cameras of the scene that goes with it."""
    from disco_twin.scene.scene import load_scene
    from hw.base.files import require_folder
    from hw.rig.rig_rules import load_rig_file
    from pipeline.capture.rig_fits_scene import require_scene

    file, shapes = load_rig_file(path), None
    if scene is not None:
        rig = load_scene(scene).rig
        require_scene(file, rig, path)
        shapes = {camera.name: (camera.height, camera.width) for camera in rig.cameras}
    if logs is not None:
        require_folder(logs, "--logs")
    return file, shapes


def _show(findings: Generator[DeviceFinding, None, None]) -> None:
    """Print them as they come. Whatever ends that, a signal or a closed pipe, what they use is made safe first."""
    good, count = True, 0
    with interruptible(), closing(findings):
        try:
            for finding in findings:
                raise_if_interrupted()  # where a device's failure on the way out hid it
                console.print(str(finding), highlight=False, markup=False, soft_wrap=True)
                good, count = good and finding.good, count + 1
        except KeyboardInterrupt:
            raise Interrupted("stopped: gates, lamps and every laser that was on were told to go off") from None
    if not count:
        console.print("every device of this rig file is emulated or simulated: there is nothing to connect to")
    if not good:
        raise typer.Exit(1)
