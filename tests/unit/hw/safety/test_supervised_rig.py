"""Board and laser of one program: gates, floodlight, warning lamp and emission end with it, however it ends.

Real drivers, emulated devices on pseudo-terminals in real time; the program is a few lines.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable

import pytest
from rig_programs import FLOOD, GATE, LAMP, Bench
from supervisor_fakes import LIMIT_S, Run, supervisors_of

from disco_twin.emulation.emulated_rig import Emulation
from hw.rig.connect import Connector
from hw.rig.rig_rules import load_rig_file

LIT = f"""
import sys, time
from pathlib import Path
import hw.devices.mm_ard
hw.devices.mm_ard.BOOT_S = 0.05
from hw.rig.connect import Connector
from hw.rig.rig_rules import load_rig_file
from hw.safety.signals import interruptible
connect = Connector(load_rig_file(Path(sys.argv[1])))
with interruptible():
    board, laser = connect.board(), connect.omicron(0)
    try:
        board.set_lines({LAMP | FLOOD | GATE})
        laser.arm(10.0)
        laser.emit()
        print("on", flush=True)
        time.sleep(60.0)
    finally:
        laser.close()
        board.close()
"""


def lit(emulated: Emulation) -> Callable[[], tuple[bool, bool]]:
    """Whether anything of lines and laser is on: all is, to begin with."""
    bench = emulated.bench
    assert bench.board.lines == LAMP | FLOOD | GATE and bench.heads[0].on_since is not None
    return lambda: (bench.board.lines != 0, bench.heads[0].on_since is not None)


def dark_within(limit_s: float, state: Callable[[], tuple[bool, bool]]) -> float:
    begun = time.monotonic()
    while any(state()):
        assert time.monotonic() - begun < limit_s, f"(lines, laser) are on: {state()}"
        time.sleep(0.001)
    return time.monotonic() - begun


@pytest.mark.timing
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM])
def test_lines_and_laser_end_with_the_program(devices: Bench, run: Run, number: signal.Signals) -> None:
    emulated, _, rig = devices
    program = run(None, str(rig), LIT)
    state = lit(emulated)
    program.send_signal(number)
    dark_within(LIMIT_S, state)
    if number == signal.SIGSTOP:
        program.send_signal(signal.SIGCONT)
        time.sleep(0.1)  # while it is stopped the kernel gives a signal to any of its threads
        program.send_signal(signal.SIGTERM)
    program.wait(5.0)
    end = time.monotonic() + 5.0
    while supervisors_of(program.pid):  # it ends when everything has confirmed
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.timing
def test_ctrl_c_ends_within_two_seconds_though_the_laser_is_mute(devices: Bench, run: Run) -> None:
    """Its adapter lives. Expected: lines are low at once, the program ends, its supervisor insists alone."""
    emulated, _, rig = devices
    program = run(None, str(rig), LIT)
    lit(emulated)
    firmware = emulated.cables["laser0"].firmware
    hear = firmware.feed
    firmware.feed = lambda data, now: []  # type: ignore[method-assign]
    begun = time.monotonic()
    program.send_signal(signal.SIGINT)
    dark_within(LIMIT_S, lambda: (emulated.bench.board.lines != 0, False))
    program.wait(5.0)
    assert time.monotonic() - begun < 2.0
    assert emulated.bench.heads[0].on_since is not None and len(supervisors_of(program.pid)) == 1
    firmware.feed = hear  # type: ignore[method-assign]
    dark_within(LIMIT_S, lambda: (False, emulated.bench.heads[0].on_since is not None))


@pytest.mark.timing
@pytest.mark.parametrize("fault", ["deaf", "mute", "in the middle of a command"])
def test_it_insists_until_the_board_confirms_that_its_lines_are_low(
    devices: Bench, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    """Expected: told again until it hears; not given back before it has answered; unfinished commands do no harm."""
    emulated, _, rig = devices
    board = Connector(load_rig_file(rig)).board()
    board.set_lines(LAMP | GATE)
    cable = emulated.cables["board"]
    if fault == "deaf":
        cable.command_faults.extend([lambda data: b""] * 5)
    elif fault == "mute":
        cable.answer_faults.extend([lambda data: []] * 5)
    else:
        board.link.write(bytes([3, 0]))  # to a mirror: two arguments are missing
    board.link.close()
    assert emulated.bench.board.lines == 0
    assert not cable.command_faults and not cable.answer_faults
