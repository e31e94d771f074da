"""A capture through drivers, lines and emulated firmware is the direct twin's, byte for byte."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from capture_fakes import contents
from twin_fakes import FAULTS, PLAN, RIG, Glow

from disco_twin.emulation.emulated_rig import Emulation
from disco_twin.emulation.twin_rig import FRAMES_PER_IMAGE, TURN_S, TwinRig
from hw.base.clock import VirtualClock
from hw.base.errors import DeviceFault, Refused
from hw.interface import Rig
from hw.rig.connect import Connector
from hw.rig.serial_rig import SerialRig
from pipeline.capture.loop import capture

assert FAULTS.warm_up


def emulation(fail_at: int = -1) -> Emulation:
    return Emulation(TwinRig(RIG, Glow(fail_at), seed=5))


def test_capture_through_serial_lines_equals_the_direct_twin(tmp_path: Path) -> None:
    """Rationale: drivers, protocols and firmware may change neither images nor their record.

    Expected behaviour: images.bin, journal.bin and plan.json are the same bytes, every rig fault being on.
    """
    direct, serial = tmp_path / "direct", tmp_path / "serial"
    capture(TwinRig(RIG, Glow(), seed=5), PLAN, direct)
    emulated = emulation()
    capture(emulated.serial_rig(tmp_path / "logs"), PLAN, serial)
    assert contents(serial) == contents(direct)
    assert emulated.bench.hazards == []
    assert sorted(p.name for p in (tmp_path / "logs").iterdir()) == sorted(f"{n}.log" for n in emulated.cables)


@pytest.mark.parametrize("fail_at", [0, 1, 7, 11, 21])
def test_resumed_serial_capture_equals_the_direct_one(tmp_path: Path, fail_at: int) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    capture(TwinRig(RIG, Glow(), seed=5), PLAN, whole)
    with pytest.raises(RuntimeError, match="out of light"):
        capture(emulation(fail_at).serial_rig(), PLAN, parts)
    assert capture(emulation().serial_rig(), PLAN, parts) == fail_at
    assert contents(parts) == contents(whole)


def test_everything_is_dark_afterwards() -> None:
    emulated = emulation()
    with emulated.serial_rig() as rig:
        assert [head.emission(emulated.clock.now()) for head in emulated.bench.heads] == [1.0, 1.0, 1.0]
        rig.lasers[1].open_gate()
        assert emulated.bench.light() == [1]
    assert emulated.bench.light() == []
    assert [head.on_since for head in emulated.bench.heads] == [None] * 3
    assert emulated.bench.board.lines == 0


def test_commands_of_an_image_fit_into_the_discarded_frame() -> None:
    """Why the record's clock does not count them: they pass while a frame is discarded anyway."""
    emulated = emulation()
    clock = emulated.clock
    frames = FRAMES_PER_IMAGE * RIG.sensor.longest_exposure_s
    with emulated.serial_rig() as rig:
        for u in (1900, 4095, 0):
            start = clock.now()
            rig.projector.move(2000, u)
            assert emulated.bench.board.settled(clock.now())
            rig.lasers[0].open_gate()
            rig.cameras[0].expose()
            rig.photodiode.read()
            rig.lasers[0].close_gate()
            assert clock.now() - start - frames < RIG.sensor.longest_exposure_s
        start = clock.now()
        rig.turntable.move(np.pi)
        assert clock.now() - start < TURN_S


@pytest.mark.parametrize("make", [lambda: TwinRig(RIG, Glow(), seed=5), lambda: emulation().serial_rig()])
def test_direct_and_serial_rig_refuse_the_same(make: object) -> None:
    rig: Rig = make()  # type: ignore[operator]
    with pytest.raises(Refused, match="switched off"):
        rig.projector.move(1, 1)
    with rig:
        rig.lasers[0].open_gate()
        with pytest.raises(Refused, match="one laser at a time"):
            rig.lasers[1].open_gate()
        with pytest.raises(Refused, match="must not move while the gate of laser 0 is open"):
            rig.projector.move(1, 1)
        with pytest.raises(Refused, match="must not move while the gate of laser 0 is open"):
            rig.turntable.move(np.pi)
        rig.lasers[1].close_gate()
        rig.lasers[0].close_gate()
        rig.turntable.move(np.pi)
    with pytest.raises(Refused, match="switched off"):
        rig.lasers[0].open_gate()


def test_a_laser_that_goes_out_is_noticed_at_the_photodiode() -> None:
    emulated = emulation()
    with emulated.serial_rig() as rig:
        rig.lasers[2].open_gate()
        rig.cameras[0].expose()
        emulated.bench.heads[2].set_interlock(closed=False)
        with pytest.raises(DeviceFault, match=r"laser 476 nm gives 0\.00 mW \(0 counts\) at the photodiode"):
            rig.photodiode.read()


def test_a_rig_that_cannot_be_connected_leaves_nothing_on(tmp_path: Path) -> None:
    emulated = emulation()
    emulated.bench.spindle.sticks_at_deg = 0.0
    with pytest.raises(DeviceFault, match="turntable"), emulated.serial_rig():
        raise AssertionError
    assert [head.on_since for head in emulated.bench.heads] == [None] * 3
    assert emulated.bench.board.lines == 0


def test_a_clock_of_its_own_for_real_rigs() -> None:
    clock = VirtualClock(1000.0)
    emulated = Emulation(TwinRig(RIG, Glow(), seed=5), clock)
    model = emulated.serial_rig()
    connector = Connector(model.file, emulated.stand_ins(cameras=False))
    rig = SerialRig(connector, emulated.bench.cameras, armed=True)
    with rig:
        assert rig.now() == 0.0
        clock.sleep(2.5)
        assert rig.now() == 2.5
        rig.resume_at(100.0)
        clock.sleep(1.0)
        assert rig.now() == 101.0


@pytest.mark.parametrize("error", [DeviceFault, KeyboardInterrupt])
def test_what_fails_while_lasers_warm_up_leaves_nothing_on(error: type[BaseException]) -> None:
    """Without the capture loop, which would make the rig safe once more."""
    emulated = emulation()
    rig, sleep = emulated.serial_rig(), emulated.clock.sleep
    rig.file = rig.file.model_copy(update={"warm_up_s": 0.4375})  # less than the supervisor is asked after
    lit = []

    def disturbed(seconds: float) -> None:
        sleep(seconds)
        if seconds == 0.4375:
            lit.append([head.on_since is not None for head in emulated.bench.heads])
            if error is KeyboardInterrupt:
                raise KeyboardInterrupt
            emulated.bench.heads[2].set_interlock(closed=False)

    emulated.clock.sleep = disturbed  # type: ignore[method-assign]
    with pytest.raises(error), rig:
        raise AssertionError
    assert lit == [[True] * 3]
    assert [head.on_since for head in emulated.bench.heads] == [None] * 3
    assert emulated.bench.board.lines == 0 and emulated.bench.hazards == []
    assert not rig.connected
