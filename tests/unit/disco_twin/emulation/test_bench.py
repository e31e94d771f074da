"""The bench: emulated devices move the twin, its cameras see them, and what must never happen is written down."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from capture_fakes import contents
from twin_fakes import PLAN, RIG, Glow

from disco_twin.emulation.bench import LAMP_LINE
from disco_twin.emulation.emulated_rig import Emulation
from disco_twin.emulation.twin_rig import TwinRig
from disco_twin.scene.rig_schema import FaultsConfig
from hw.base.errors import DeviceFault, DiscoError, InputError, Refused, Unplugged
from hw.devices.omicron_protocol import Mode
from hw.serial.link import Link
from pipeline.capture.loop import capture
from pipeline.geometry.nominal_rig import ProjectorConfig
from pipeline.stream.stream import StreamReader


@pytest.fixture
def emulated() -> Emulation:
    return Emulation(TwinRig(RIG, Glow(), seed=5))


def test_light_needs_emission_release_and_gate(emulated: Emulation) -> None:
    bench = emulated.bench
    with emulated.serial_rig() as rig:
        assert bench.light() == []
        rig.lasers[1].open_gate()
        assert bench.light() == [1]
        bench.heads[1].mode &= ~(1 << 4)
        assert bench.light() == []
        bench.heads[1].mode |= 1 << 4
        bench.heads[1].set_key(on=False)
        assert bench.light() == []


def test_the_set_point_scales_the_light() -> None:
    """A quarter of the power, a quarter of the photodiode's counts: within its noise of 0.1 % and its count."""
    emulated = Emulation(TwinRig(RIG.model_copy(update={"faults": FaultsConfig()}), Glow(), seed=5))
    bench = emulated.bench
    with emulated.serial_rig() as rig:
        readings = []
        for level in (1.0, 0.5, 0.25):
            bench.heads[0].level = level
            rig.lasers[0].open_gate()
            rig.cameras[0].expose()
            readings.append(rig.photodiode.read() / (level * 10e-3))
            rig.lasers[0].close_gate()
    assert np.array(readings) == pytest.approx(1.0, rel=0.01)


def test_a_camera_in_front_of_moving_things_refuses(emulated: Emulation) -> None:
    bench = emulated.bench
    with emulated.serial_rig() as rig:
        bench.board.set_pattern(0b1)
        bench.board.galvos[0].aim(0, emulated.clock.now() + 0.05)
        with pytest.raises(DiscoError, match="mirrors moving"):
            rig.cameras[0].expose()
        bench.board.set_pattern(0)
        emulated.clock.sleep(1.0)
        bench.spindle.go(180.0, emulated.clock.now())
        with pytest.raises(DiscoError, match="no light for a turntable at"):
            rig.cameras[0].expose()
        emulated.clock.sleep(10.0)
        rig.cameras[0].expose()
        bench.spindle.go(90.0, emulated.clock.now())
        emulated.clock.sleep(10.0)
        with pytest.raises(DiscoError, match=r"no light for a turntable at 90\.00 deg"):
            rig.cameras[0].expose()


def test_hazards_are_written_down(emulated: Emulation) -> None:
    """Behind the rig's back, since the rig refuses them: at the change itself, whether a camera looks or not."""
    bench, lamp = emulated.bench, 1 << LAMP_LINE

    def news() -> list[str]:
        found, bench.hazards = bench.hazards, []
        return found

    with emulated.serial_rig() as rig:
        bench.board.set_pattern(lamp | 0b011)
        assert news() == ["gates [0, 1] are open at once"]
        with pytest.raises(DiscoError, match=r"lasers \[0, 1\] at once"):
            rig.cameras[0].expose()
        bench.board.set_pattern(lamp | 0b001)
        bench.board.write(0, 5, emulated.clock.now())
        bench.spindle.go(180.0, emulated.clock.now())
        assert news() == ["the mirrors moved with open gates [0]", "the turntable moved with open gates [0]"]
        bench.board.set_pattern(lamp)
        assert news() == []
        bench.board.set_pattern(lamp | 0b010)
        assert news() == ["gates [1] are open while a mirror still moves",
                          "gates [1] are open while the turntable still moves"]  # fmt: skip
        emulated.clock.sleep(30.0)
        bench.board.set_pattern(0b010)
        assert news() == ["laser [1] shines without the warning lamp"]
        bench.heads[0].on_since = bench.heads[1].on_since = None
        bench.board.set_pattern(0b001)
        bench.board.write(1, 7, emulated.clock.now())
        assert news() == ["the mirrors moved with open gates [0]"]  # though nothing shines
        assert bench.heads[0].switch_on(emulated.clock.now())
        assert news() == ["laser 0 is started without the warning lamp", "laser 0 is started behind an open gate"]
    news()


def test_a_laser_that_emits_when_its_port_is_given_back_is_a_hazard(emulated: Emulation) -> None:
    head = emulated.bench.heads[2]
    link = Link(emulated.attach()["laser2"], 500_000, "laser", emulated.clock)
    head.level, head.mode, head.on_since = 1.0, int(Mode.BIAS | Mode.RELEASE), -10.0
    link.close()
    assert emulated.bench.hazards == ["laser 2 emits and nobody holds its port"]


def test_a_rig_in_all_its_phases_is_no_hazard(emulated: Emulation, tmp_path: Path) -> None:
    """Rationale: the hazards above are looked for in every capture. Expected: the lamp before lasers, none found."""
    order = []
    for index, head in enumerate(emulated.bench.heads):
        before = head.on_start
        head.on_start = lambda i=index, b=before: (order.append((i, emulated.bench.board.lines)), b())[1]  # type: ignore[misc]
    capture(emulated.serial_rig(), PLAN, tmp_path)
    assert order == [(i, 1 << LAMP_LINE) for i in range(3)]
    assert emulated.bench.hazards == []


def test_more_mirror_steps_than_the_dac_has_are_refused() -> None:
    projector = ProjectorConfig(steps=8192)
    with pytest.raises(InputError, match="8192"):
        Emulation(TwinRig(RIG.model_copy(update={"projector": projector}), Glow(), seed=5))


# ---- faults in the middle of a scan: the capture stops with the reason, and goes on as if nothing had happened


def at_image(number: int, act: Callable[[Emulation], None]) -> Callable[[Emulation], None]:
    """Arrange that something happens during an exposure."""

    def arrange(emulated: Emulation) -> None:
        bench, left = emulated.bench, [number]
        look = bench.look

        def counting() -> None:
            look()
            left[0] -= 1
            if left[0] == 0:
                act(emulated)

        bench.look = counting  # type: ignore[method-assign]

    return arrange


def stall(emulated: Emulation) -> None:
    emulated.bench.spindle.sticks_at_deg = 90.0


FAULTS: dict[str, tuple[Callable[[Emulation], None], str]] = {
    "interlock": (lambda e: e.bench.heads[1].set_interlock(closed=False), "laser 532 nm gives 0.00 mW"),
    "key": (lambda e: e.bench.heads[1].set_key(on=False), "laser 532 nm gives 0.00 mW"),
    "laser's power": (lambda e: e.cables["laser1"].power_cycle(), "laser 532 nm gives 0.00 mW"),
    "board unplugged": (lambda e: e.cables["board"].unplug(), "mirror board"),
    "board's power": (lambda e: e.cables["board"].power_cycle(), "mirror board|gives 0.00 mW|TTL lines"),
    "turntable unplugged": (lambda e: e.cables["turntable"].unplug(), "turntable"),
    "turntable's power": (lambda e: e.cables["turntable"].power_cycle(), "turntable"),
    "stall": (stall, "turntable has stalled"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_in_mid_scan_stops_it_with_its_reason_and_costs_no_image(name: str, tmp_path: Path) -> None:
    """Afterwards everything is dark, what is stored is right, and the resumed capture is the uninterrupted one."""
    act, message = FAULTS[name]
    capture(TwinRig(RIG, Glow(), seed=5), PLAN, tmp_path / "whole")
    emulated = Emulation(TwinRig(RIG, Glow(), seed=5))
    at_image(4, act)(emulated)
    with pytest.raises(DiscoError, match=message):
        capture(emulated.serial_rig(), PLAN, tmp_path / "parts")
    reachable = [h for i, h in enumerate(emulated.bench.heads) if emulated.cables[f"laser{i}"].plugged]
    assert all(head.emission(emulated.clock.now()) == 0.0 for head in reachable)
    with StreamReader(tmp_path / "parts") as stored:
        assert 3 <= len(stored) < len(PLAN)
    capture(Emulation(TwinRig(RIG, Glow(), seed=5)).serial_rig(), PLAN, tmp_path / "parts")
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")
    assert emulated.bench.hazards == []


def test_the_same_bench_can_be_used_again_after_an_interlock(tmp_path: Path) -> None:
    """Closed again, the laser is reset when it is armed anew."""
    emulated = Emulation(TwinRig(RIG, Glow(), seed=5))
    at_image(3, lambda e: e.bench.heads[0].set_interlock(closed=False))(emulated)
    rig = emulated.serial_rig()
    with pytest.raises(DeviceFault, match="laser 635 nm"):
        capture(rig, PLAN, tmp_path)
    with pytest.raises(DeviceFault, match="the interlock is open"):
        capture(rig, PLAN, tmp_path)
    emulated.bench.heads[0].set_interlock(closed=True)
    capture(rig, PLAN, tmp_path)


def test_nothing_works_outside_with(emulated: Emulation) -> None:
    rig = emulated.serial_rig()
    for call in (rig.photodiode.read, rig.floodlight.on, lambda: rig.turntable.move(0.0), rig.lasers[0].open_gate):
        with pytest.raises(Refused, match="switched off"):
            call()
    rig.floodlight.off()
    rig.lasers[0].close_gate()
    rig.make_safe()
    emulated.cables["turntable"].unplug()
    with pytest.raises(Unplugged, match="turntable"), rig:
        raise AssertionError
