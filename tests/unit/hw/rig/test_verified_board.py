"""What the rig believes of its mirror board, and when it stops believing it: resets, slow and lost answers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rig_fakes import at_message, emulation, reset
from twin_fakes import RIG

from disco_twin.emulation.rig_file_of import rig_file_of
from hw.base.clock import VirtualClock
from hw.base.errors import DeviceFault, DeviceRefused, Refused, SwitchedOff
from hw.rig.connect import keys_named
from hw.rig.rig_rules import load_rig_file
from hw.rig.verified_board import VerifiedBoard


class FakeBoard:
    """Writes down what it is told. `befall`: what happens to the next pattern that opens a gate."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock, self.told, self.pattern = clock, list[str](), 0
        self.befall: list[Callable[[], None]] = []
        self.lost: Callable[[], None] = lambda: None

    def when_lost(self, action: Callable[[], None]) -> None:
        self.lost = action

    def set_mirrors(self, u: int, v: int) -> None:
        self.told.append(f"aim {u} {v}")

    def set_lines(self, pattern: int) -> None:
        self.told.append(f"lines {pattern}")
        if pattern and self.befall:
            self.befall.pop(0)()
        self.pattern = pattern

    def lines(self) -> int:
        return self.pattern

    def darken(self) -> None:
        self.told.append("shut now")

    def shut(self) -> None:
        self.told.append("shut")

    def counts(self, pin: int) -> int:
        return pin

    def close(self) -> None: ...


def trusted() -> tuple[VerifiedBoard, FakeBoard, list[str]]:
    clock = VirtualClock()
    fake, cuts = FakeBoard(clock), list[str]()
    board = VerifiedBoard(fake, clock, [0, 1], lambda: cuts.append("cut"))
    board.aim(7, 8)
    fake.told.clear()
    return board, fake, cuts


def test_a_gate_that_did_not_answer_is_told_to_shut_and_opened_again_after_aiming_anew() -> None:
    board, fake, cuts = trusted()
    fake.befall = [lambda: fake.lost()]  # the driver asks what to do before it repeats anything
    board.open_gate(0)
    assert fake.told == ["lines 1", "shut now", "lines 0", "aim 7 8", "lines 1"]
    assert cuts == [] and board.lit(0)


def test_an_opening_that_came_slowly_is_not_trusted() -> None:
    board, fake, _ = trusted()
    fake.befall = [lambda: fake.clock.sleep(0.16)]
    board.open_gate(1)
    assert fake.told == ["lines 2", "lines 0", "aim 7 8", "lines 2"]


def test_a_board_that_never_answers_promptly_is_given_up() -> None:
    board, fake, _ = trusted()
    fake.befall = [lambda: fake.clock.sleep(0.16)] * 9
    with pytest.raises(DeviceFault, match=r"did not open a gate promptly in 3 attempts.*Remedy"):
        board.open_gate(1)
    assert fake.told[-1] == "lines 0" and not board.lit(1)


def test_an_answer_that_is_lost_with_a_gate_open_cuts_every_light_and_without_one_does_not() -> None:
    board, fake, cuts = trusted()
    fake.lost()
    assert cuts == []
    board.open_gate(0)
    fake.lost()
    assert cuts == ["cut"]


def test_lines_that_the_program_shut_itself_are_no_reset() -> None:
    """An answer that came late with a gate open: what is said then is that, not the power supply's fault."""
    board, fake, _ = trusted()
    board.open_gate(0)
    lines = fake.lines

    def late() -> int:
        fake.lost()
        fake.pattern = 0
        return lines()

    fake.lines = late  # type: ignore[method-assign]
    with pytest.raises(DeviceFault, match=r"^board: the mirror board lost an answer while a gate was open: the lasers"):
        board.require_lines()
    with pytest.raises(DeviceFault, match="lost an answer"):
        board.counts(0)
    board.switch(0, False)  # always allowed


def test_errors_of_a_rig_that_runs_name_file_key_and_port(tmp_path: Path) -> None:
    """Expected: rig file, key, port, cause; what the rig says of its board is of that port."""
    url, path = "/dev/ttyACM0", tmp_path / "rig.toml"
    path.write_text(rig_file_of(RIG, {"board": url}))
    file = load_rig_file(path)
    problem = DeviceFault("board", "the mirror board", "lost an answer", "none")
    with (
        pytest.raises(DeviceFault, match=rf"^{path}: board.port = '{url}': the mirror board lost an"),
        keys_named(file),
    ):
        raise problem
    laser = SwitchedOff("supervised://laser:/dev/ttyUSB7", "the port of laser 635 nm", "is closed", "none")
    path.write_text(rig_file_of(RIG, {"laser0": "/dev/ttyUSB7"}))
    with (
        pytest.raises(SwitchedOff, match=rf"^{path}: lasers\[0\].port = '/dev/ttyUSB7': "),
        keys_named(load_rig_file(path)),
    ):
        raise laser


def test_a_reset_in_an_exposure_is_called_a_reset() -> None:
    """Not a laser that gives nothing, which it looks like at the photodiode."""
    emulated = emulation()
    with emulated.serial_rig() as rig:
        rig.lasers[0].open_gate()
        reset(emulated)
        with pytest.raises(DeviceFault, match="it was reset"):
            rig.photodiode.read()


def test_a_reset_behind_any_slow_answer_makes_the_mirrors_be_aimed_anew() -> None:
    """The floodlight's command is lost in a reset, and given again: witness high, mirrors elsewhere."""
    emulated = emulation()
    with emulated.serial_rig() as rig:
        rig.projector.move(1900, 2000)
        at_message(emulated, lambda data, n: data[:4] == b"\0\0\0\x01" and data[4] & 32 > 0, lambda: reset(emulated))
        rig.floodlight.on()
        rig.floodlight.off()
        rig.lasers[0].open_gate()
        assert [galvo.target for galvo in emulated.bench.board.galvos] == [1900, 2000]
        rig.lasers[0].close_gate()
    assert emulated.bench.hazards == []


def test_a_gate_that_may_be_open_counts_as_open() -> None:
    emulated = emulation()
    with emulated.serial_rig() as rig:
        board = rig.drivers().board
        refuse, works = DeviceRefused("board", "the mirror board", "does not follow", "none"), board.set_lines

        def refused(pattern: int) -> None:
            works(pattern)
            raise refuse

        board.set_lines = refused  # type: ignore[method-assign]
        with pytest.raises(DeviceRefused):
            rig.lasers[2].open_gate()
        assert emulated.bench.light() == [2]
        for move in (lambda: rig.turntable.move(np.pi), lambda: rig.projector.move(1, 2), rig.lasers[0].open_gate):
            with pytest.raises(Refused, match="gate of laser 2 is open"):
                move()
        board.set_lines = works  # type: ignore[method-assign]
        rig.lasers[2].close_gate()
        assert emulated.bench.light() == [] and rig.open_gate == -1
