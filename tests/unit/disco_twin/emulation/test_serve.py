"""Emulated devices behind terminals and sockets, spoken to by our drivers and by clients that are not ours."""

from __future__ import annotations

import importlib.metadata
import sys
import time
import types
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import serial
from capture_fakes import contents
from replay import ReplayPeer, read_log
from serial_fakes import PatientClock, ScaledClock
from twin_fakes import PLAN, RIG, Glow

from disco_twin.emulation.emulated_rig import Emulation
from disco_twin.emulation.serve import Server
from disco_twin.emulation.served_rig import emulated_devices
from disco_twin.emulation.twin_rig import TwinRig
from disco_twin.firmware.elliptec import ElliptecFirmware
from disco_twin.firmware.mm_ard import MirrorHead, MmArdFirmware
from disco_twin.firmware.omicron import LaserHead, OmicronFirmware
from disco_twin.firmware.turning import Spindle
from disco_twin.firmware.wire import Cable
from disco_twin.firmware.zaber import MICROSTEPS_PER_DEG, ZaberFirmware
from hw.base.clock import VirtualClock
from hw.base.errors import Unplugged
from hw.devices.mm_ard import MirrorBoard
from hw.devices.omicron import OmicronLaser
from hw.devices.omicron_protocol import Mode
from hw.devices.zaber import ZaberTable
from hw.serial.bytelog import ByteLog
from hw.serial.link import Link
from hw.serial.ports.protocol_memory import attach
from pipeline.capture.loop import capture


class Desk:
    """A laser, a board and a turntable."""

    def __init__(self) -> None:
        self.clock = ScaledClock()
        self.head, self.mirrors, self.spindle = LaserHead(532.0, 100.0), MirrorHead(), Spindle(30.0)
        self.lines = {
            "laser": Cable(OmicronFirmware(self.head), self.clock),
            "board": Cable(MmArdFirmware(self.mirrors), self.clock),
            "turntable": Cable(ZaberFirmware(self.spindle), self.clock),
        }


@pytest.fixture(params=["terminals", "sockets"])
def served(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Desk, Server]]:
    desk = Desk()
    with Server(desk.lines, tmp_path if request.param == "terminals" else None) as server:
        yield desk, server


@pytest.mark.parametrize("through", ["terminals", "sockets"])
def test_a_laser_whose_port_nobody_holds_is_seen_on_sockets_alone(tmp_path: Path, through: str) -> None:
    """A terminal does not say when it is closed (decision 0036): what stands in for it must not rely on this."""
    emulated = emulated_devices(RIG, seed=1)
    head = emulated.bench.heads[0]
    with Server({"laser0": emulated.cables["laser0"]}, tmp_path if through == "terminals" else None) as server:
        head.mode, head.level, head.on_since = int(Mode.BIAS | Mode.RELEASE), 1.0, time.monotonic() - 60.0
        with serial.serial_for_url(server.urls["laser0"], timeout=2.0) as port:
            port.write(b"?GAS\r")
            assert port.read_until(b"\r") == b"!GAS02C2\r"
        end = time.monotonic() + 2.0
        while through == "sockets" and not emulated.bench.hazards and time.monotonic() < end:
            time.sleep(0.01)
    expected = ["laser 0 emits and nobody holds its port"] if through == "sockets" else []
    assert emulated.bench.hazards == expected


def test_drivers_work_through_terminals_and_sockets(served: tuple[Desk, Server]) -> None:
    desk, server = served
    urls, clock = server.urls, desk.clock
    laser = OmicronLaser(Link(urls["laser"], 500_000, "laser 532 nm", clock), 532.0)
    board = MirrorBoard(Link(urls["board"], 57_600, "mirror board", clock))
    table = ZaberTable(Link(urls["turntable"], 115_200, "turntable", clock), MICROSTEPS_PER_DEG)
    laser.arm(30.0)
    laser.emit()
    assert laser.measured_mw() == pytest.approx(30.0)
    board.set_mirrors(11, 4001)
    board.set_lines(0b100)
    assert [g.target for g in desk.mirrors.galvos] == [11, 4001]
    table.home()
    table.move(np.deg2rad(120.0))
    assert desk.spindle.angle_deg == pytest.approx(120.0)
    for device in (laser, board, table):
        device.close()
    assert desk.head.on_since is None
    assert desk.mirrors.lines == 0


def test_a_session_that_was_recorded_in_real_time_replays(served: tuple[Desk, Server], tmp_path: Path) -> None:
    """As the first run on a bench will be: recorded with all its pauses, replayed in no time on a virtual clock."""
    desk, server = served
    log = tmp_path / "logs" / "laser.log"

    def session(link: Link) -> tuple[object, ...]:
        laser = OmicronLaser(link, 532.0)
        laser.arm(30.0)
        laser.emit()
        result = (laser.identity, laser.status(), laser.measured_mw())
        laser.close()
        return result

    recorded = session(Link(server.urls["laser"], 500_000, "laser 532 nm", desk.clock, ByteLog(log)))
    events = read_log(log)
    clock = VirtualClock(events[0].time_s)
    peer = ReplayPeer(events, clock)
    assert session(Link(attach("recorded", peer), 500_000, "laser 532 nm", clock)) == recorded
    assert peer.finished


def test_unplug_and_replug(served: tuple[Desk, Server]) -> None:
    """Closing the master makes the driver's port fail; a new one is found under the same name."""
    desk, server = served
    link = Link(server.urls["turntable"], 115_200, "turntable", desk.clock)
    table = ZaberTable(link, MICROSTEPS_PER_DEG)
    server.unplug("turntable")
    with pytest.raises(Unplugged, match="the port of turntable"):
        table.angle_rad()
    link.close()
    server.plug("turntable")
    table = ZaberTable(Link(server.urls["turntable"], 115_200, "turntable", desk.clock), MICROSTEPS_PER_DEG)
    table.home()
    table.close()


def test_a_capture_through_terminals_equals_the_direct_twin(tmp_path: Path) -> None:
    """Bytes come when they come; nobody waits for turns and exposures."""
    capture(TwinRig(RIG, Glow(), seed=5), PLAN, tmp_path / "direct")
    emulated = Emulation(TwinRig(RIG, Glow(), seed=5), PatientClock())
    ports = tmp_path / "ports"
    ports.mkdir()
    with Server(emulated.cables, ports) as server:
        capture(emulated.serial_rig(urls=server.urls), PLAN, tmp_path / "serial")
    assert contents(tmp_path / "serial") == contents(tmp_path / "direct")
    assert emulated.bench.hazards == []


# ---- clients that are not ours


def test_zabers_own_library_homes_and_moves_the_emulated_turntable() -> None:
    """Outside check: Zaber's client finds, homes and moves the stage, and understands where it stands."""
    ascii_ = pytest.importorskip("zaber_motion.ascii")
    desk = Desk()
    turntable = {"turntable": desk.lines["turntable"]}
    with Server(turntable, None) as server:
        port = int(server.urls["turntable"].rsplit(":", 1)[1])
        with ascii_.Connection.open_tcp("127.0.0.1", port) as connection:
            connection.enable_alerts()
            (device,) = connection.detect_devices(identify_devices=False)
            assert device.device_address == 1
            axis = device.get_axis(1)
            assert not axis.is_homed()
            axis.home()
            assert axis.is_homed()
            assert axis.get_position() == 0
            axis.move_absolute(256_000)
            assert axis.get_position() == 256_000
            assert desk.spindle.position(desk.clock.now()) == pytest.approx(120.0)
            axis.move_absolute(512_000, wait_until_idle=False)
            axis.stop()
            assert 256_000 < axis.get_position() < 512_000
            assert not axis.is_busy()
            with pytest.raises(Exception, match="BADCOMMAND"):
                device.generic_command("no such command")
            desk.spindle.sticks_at_deg = 60.0
            with pytest.raises(Exception, match=r"[Ss]tall"):
                axis.move_absolute(0)


def luxx_client() -> types.ModuleType:
    """luxx-communication 0.1.4 is written for Python 2: translated as it is loaded, its text sent as latin-1."""
    lib2to3 = pytest.importorskip("fissix.refactor")
    try:
        files = importlib.metadata.files("luxx-communication") or []
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("luxx-communication is not installed")
    source = next(Path(str(f.locate())) for f in files if f.name == "luxx_communication.py").read_text()
    fixers = lib2to3.get_fixers_from_package("fissix.fixes")
    tree = lib2to3.RefactoringTool(fixers).refactor_string(source + "\n", "luxx")

    class Text(serial.Serial):
        """Text in, text out, as Python 2 had it."""

        def write(self, text: str) -> int | None:  # type: ignore[override]
            return super().write(text.encode("latin-1"))

        def readall(self) -> str:  # type: ignore[override]
            return super().readall().decode("latin-1")

    module = types.ModuleType("luxx")
    shim = types.ModuleType("serial")
    shim.Serial, shim.SerialException = Text, serial.SerialException  # type: ignore[attr-defined]
    before = sys.modules["serial"]
    sys.modules["serial"] = shim
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # its docstrings' escapes
            exec(compile(str(tree), "luxx_communication.py", "exec"), module.__dict__)
    finally:
        sys.modules["serial"] = before
    return module


def test_a_published_laser_client_talks_to_the_emulated_laser(tmp_path: Path) -> None:
    """Outside check: luxx-communication identifies, sets, starts and stops the laser over a terminal."""
    luxx = luxx_client()
    desk = Desk()
    with Server({"laser": desk.lines["laser"]}, tmp_path) as server:
        laser = luxx.Laser(port=server.urls["laser"])
        assert laser.firmware.startswith("LuxX | 4 | ")
        assert (laser.wavelength, laser.pmax, laser.serial) == (532.0, 100.0, "4711")
        laser.set_power(25.0)
        assert laser.get_power() == pytest.approx(25.0, abs=0.03)
        laser.set_mode("CW-ACC")
        assert laser.get_mode() == "CW-ACC"
        laser.set_autostart(False)
        laser.start()
        desk.clock.sleep(4.0)
        assert float(laser.ask("MDP")) == pytest.approx(25.0, abs=0.05)
        laser.stop()
        assert float(laser.ask("MDP")) == 0.0
        laser.port.close()


def test_a_published_elliptec_client_turns_the_emulated_stage(tmp_path: Path) -> None:
    """Outside check: the client thorlabs-elliptec."""
    elliptec = pytest.importorskip("thorlabs_elliptec")
    clock, spindle = ScaledClock(), Spindle(30.0)
    with Server({"stage": Cable(ElliptecFirmware(spindle), clock)}, tmp_path) as server:
        stage = elliptec.ELLx(serial_port=server.urls["stage"], x=14)
        stage.home()
        stage.move_absolute(120.0, blocking=True)
        assert stage.get_position() == pytest.approx(120.0, abs=0.01)
        assert spindle.position(clock.now()) == pytest.approx(120.0, abs=0.01)
        stage.close()
