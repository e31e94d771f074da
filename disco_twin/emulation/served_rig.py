"""`disco-twin rig emulate`: the devices of a scene for another program, in real time, on pseudo-terminals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from disco_twin.emulation.emulated_rig import Emulation
from disco_twin.emulation.rig_file_of import rig_file_of
from disco_twin.emulation.serve import Server
from disco_twin.emulation.twin_rig import TwinRig, watts_per_count
from disco_twin.scene.rig_schema import TwinRigConfig
from hw.base.arrays import F32
from hw.base.clock import WallClock
from hw.base.errors import DiscoError, InputError
from hw.base.files import alone_in, require_folder, write_atomically
from hw.interface import Aim


class Darkness:
    """A response source for devices without a camera."""

    def prepare(self, aims: Sequence[Aim]) -> None:
        """Nothing to do."""

    def image(self, camera: int, aim: Aim, laser: int) -> F32:
        """Nothing looks. Raises: DiscoError."""
        raise DiscoError("these emulated devices have no camera. Remedy: a rig file with a simulated one")

    def silhouette(self, camera: int, angle: int) -> F32:
        """Nothing looks. Raises: DiscoError."""
        raise DiscoError("these emulated devices have no camera. Remedy: a rig file with a simulated one")


def emulated_devices(scene: TwinRigConfig, seed: int) -> Emulation:
    """The devices of a scene in real time, for cameras elsewhere: the photodiode reads what falls on it now."""
    emulation = Emulation(TwinRig(scene, Darkness(), seed), WallClock())
    bench = emulation.bench

    def live(pin: int) -> int:
        if bench.light() != [pin]:
            return 0
        watts = bench.heads[pin].emission(bench.clock.now()) * bench.heads[pin].max_power_mw * 1e-3
        return round(watts / watts_per_count(scene.lasers[pin]))

    bench.board.sample = live
    return emulation


@contextmanager
def served(scene: TwinRigConfig, seed: int, folder: Path) -> Iterator[Path]:
    """Emulated devices on pseudo-terminals in a folder, and the rig file that reaches them.

    Raises: InputError where a file is in the way, or another emulator serves there.
    """
    require_folder(folder, "--ports")
    lines, path = emulated_devices(scene, seed).cables, folder / "rig.toml"
    remedy = "choose another --ports, or take it away"
    problem = "an emulator that is running serves its devices here"  # its links would be taken over and taken away
    with alone_in(folder, InputError(problem, file=folder, remedy="end it, or choose another --ports")):
        for port in (folder / name for name in lines):
            if port.exists() and not port.is_symlink():
                raise InputError("is in the place of an emulated device's port", file=port, remedy=remedy)
        content = rig_file_of(scene, {name: str((folder / name).absolute()) for name in lines}).encode()
        if path.exists() and path.read_bytes() != content:
            raise InputError("is another rig file than the one to be written", file=path, remedy=remedy)
        with Server(lines, folder):
            write_atomically(path, content)
            yield path
