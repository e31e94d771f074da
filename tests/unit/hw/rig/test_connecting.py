"""Connecting to what an earlier program left lit: whatever fails, everything that can be reached is dark afterwards."""

from __future__ import annotations

import gc
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from rig_files import CAMERAS
from twin_fakes import RIG, Glow

from disco_twin.emulation.bench import FLOOD_LINE, LAMP_LINE
from disco_twin.emulation.emulated_rig import Emulation
from disco_twin.emulation.rig_file_of import rig_file_of
from disco_twin.emulation.twin_rig import TwinRig
from hw.base.errors import DeviceError, InputError
from hw.devices.mm_ard import MirrorBoard
from hw.devices.omicron import OmicronLaser
from hw.devices.omicron_protocol import Mode
from hw.rig.connect import Connector
from hw.rig.rig_rules import load_rig_file
from hw.rig.serial_rig import open_rig

LIT = 1 << LAMP_LINE | 1 << FLOOD_LINE | 0b11


def left_on() -> Emulation:
    """Lasers, gates and lamps as a program that was killed together with its supervisor leaves them."""
    emulated = Emulation(TwinRig(RIG, Glow(), seed=5))
    emulated.bench.board.set_pattern(LIT)
    for head in emulated.bench.heads:
        head.mode, head.level, head.on_since = int(Mode.BIAS | Mode.RELEASE), 1.0, emulated.clock.now() - 60.0
    return emulated


def connector(emulated: Emulation, folder: Path, change: tuple[str, str] = ("", "")) -> Connector:
    path = folder / "rig.toml"
    path.write_text(rig_file_of(RIG, {}).replace(*change, 1))
    return Connector(load_rig_file(path), emulated.stand_ins())


def silent(name: str) -> Callable[[Emulation], None]:
    """A device whose adapter lives, and which hears nothing."""

    def fall(emulated: Emulation) -> None:
        emulated.cables[name].firmware.feed = lambda data, now: []  # type: ignore[method-assign]

    return fall


@pytest.mark.parametrize("fault", ["laser0 unplugged", "laser0 silent", "laser1 silent", "turntable unplugged"])
def test_a_device_that_fails_leaves_nothing_else_lit(tmp_path: Path, fault: str) -> None:
    """Expected: gates and lamps shut, every laser that can be reached off, and the error of the one that failed."""
    emulated = left_on()
    name, kind = fault.split()
    if kind == "silent":
        silent(name)(emulated)
    connect = connector(emulated, tmp_path)
    if kind == "unplugged":
        emulated.cables[name].unplug()
    with pytest.raises(DeviceError, match={"laser0": "laser 635 nm", "laser1": "laser 532 nm"}.get(name, name)):
        connect.connect()
    assert emulated.bench.board.lines == 0
    assert [head.on_since is not None for head in emulated.bench.heads] == [f"laser{i}" == name for i in range(3)]


def test_a_board_that_fails_leaves_no_laser_on(tmp_path: Path) -> None:
    emulated = left_on()
    connect = connector(emulated, tmp_path)
    emulated.cables["board"].unplug()
    with pytest.raises(DeviceError, match="mirror board"):
        connect.connect()
    assert not any(head.on_since for head in emulated.bench.heads)


def test_every_failure_is_reported_and_no_log_stays_open(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Expected: the board's failure is raised, the laser's logged; an open file would be a warning, and so an error."""
    path = tmp_path / "rig.toml"
    path.write_text(rig_file_of(RIG, {"board": str(tmp_path / "none"), "laser1": str(tmp_path / "neither")}))
    with pytest.raises(DeviceError, match=r"board\.port"):
        Connector(load_rig_file(path), left_on().stand_ins(), tmp_path).connect()
    assert "lasers[1].port" in caplog.text
    gc.collect()


def test_a_fault_that_nobody_foresaw_leaves_nothing_else_lit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bug in the first laser's driver. Expected: the other lasers are off all the same, and it is raised."""
    emulated = left_on()
    connect = connector(emulated, tmp_path)
    real, seen = OmicronLaser._identify, list[OmicronLaser]()

    def broken(self: OmicronLaser, wavelength_nm: float) -> object:
        seen.append(self)
        if len(seen) == 1:
            raise KeyError("a bug")
        return real(self, wavelength_nm)

    monkeypatch.setattr(OmicronLaser, "_identify", broken)
    with pytest.raises(KeyError, match="a bug"):
        connect.connect()
    assert emulated.bench.board.lines == 0
    assert not any(head.on_since for head in emulated.bench.heads[1:])


def test_a_wrong_power_is_refused_in_the_dark(tmp_path: Path) -> None:
    """power_mw beyond what the first laser says of itself: a slip of the pen must not keep the others lit."""
    emulated = left_on()
    with pytest.raises(InputError, match=r"lasers\[0\]\.power_mw = 11\.0.*at most 10"):
        connector(emulated, tmp_path, ("power_mw = 10.0", "power_mw = 11.0")).connect()
    assert emulated.bench.board.lines == 0 and not any(head.on_since for head in emulated.bench.heads)


@pytest.mark.parametrize("moment", ["board", "laser"])
def test_ctrl_c_in_connecting_is_heard_in_the_dark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    """Before the board, or the first laser, has said who it is."""
    emulated = left_on()
    driver = MirrorBoard if moment == "board" else OmicronLaser
    identify, pressed = driver._identify, []

    def interrupted(self: object, *rest: object) -> object:
        if not pressed:
            pressed.append(True)
            signal.raise_signal(signal.SIGINT)
        return identify(self, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(driver, "_identify", interrupted)
    with pytest.raises(KeyboardInterrupt):
        connector(emulated, tmp_path).connect()
    assert emulated.bench.board.lines == 0 and not any(head.on_since for head in emulated.bench.heads)


def test_what_is_emulated_or_simulated_and_not_handed_in_is_named(tmp_path: Path) -> None:
    """A script on hw alone. Expected: file, key and remedy, before a byte is sent to any device."""
    path = tmp_path / "rig.toml"
    path.write_text(rig_file_of(RIG, {}))
    with pytest.raises(
        InputError, match=r"rig.toml: cameras: are simulated, and none are handed in. Remedy: "
    ) as caught:
        open_rig(load_rig_file(path), {}, armed=True).__enter__()
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"rig.toml: board.port = 'emulated': nothing emulates this device here. Reme"):
        Connector(load_rig_file(path)).connect()
    content = path.read_text()
    path.write_text(content[: content.index("[[cameras]]")] + CAMERAS)
    with pytest.raises(InputError, match=r"camera front needs its size. Remedy: "):
        open_rig(load_rig_file(path), {"back": (31, 48)}, armed=True).__enter__()


def test_drivers_that_are_connected_for_a_block_are_dark_and_closed_after_it(tmp_path: Path) -> None:
    """Whatever ends the block; the laser had been switched on in it."""
    emulated = left_on()
    connect = connector(emulated, tmp_path)
    with pytest.raises(RuntimeError), connect.connected() as drivers:  # noqa: PT012 - a block that fails
        assert emulated.bench.board.lines == 0 and not any(head.on_since for head in emulated.bench.heads)
        drivers.board.set_lines(1 << LAMP_LINE)
        drivers.lasers[1].arm(10.0)
        drivers.lasers[1].emit()
        assert emulated.bench.heads[1].on_since is not None
        raise RuntimeError
    assert emulated.bench.board.lines == 0 and not any(head.on_since for head in emulated.bench.heads)
    assert not any(cable._users for cable in emulated.cables.values())
