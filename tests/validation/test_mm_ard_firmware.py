"""The mirror board's driver and its emulator against the published firmware itself, running on this machine.

The firmware is not ours to ship. `MM_ARD_INO=AOTFcontroller.ino make validate` runs this with Micro-Manager's file
(mmCoreAndDevices, DeviceAdapters/Arduino/AOTFcontroller), `arduino.h` standing in for the board.
"""

from __future__ import annotations

import os
import pty
import random
import select
import shutil
import subprocess
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path

import pytest

from disco_twin.firmware.mm_ard import ARGUMENTS, MirrorHead, MmArdFirmware
from hw.base.clock import WallClock
from hw.base.errors import WrongDevice
from hw.devices import mm_ard
from hw.serial.link import Link

SKETCH = os.environ.get("MM_ARD_INO", "")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not SKETCH or shutil.which("g++") is None, reason="needs MM_ARD_INO and g++"),
]
COMMANDS = (1, 2, 3, 20, 21, 22, 30, 31, 34, 41)
NOT_EMULATED = (5, 6, 7, 8, 9, 10, 11, 12, 32, 33, 35, 40, 42)  # sequences and counts that the rig does not use


class Board:
    """The firmware as a process on a terminal; `said` is what left the board."""

    def __init__(self, program: Path, folder: Path) -> None:
        master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        self.url = os.ttyname(self.slave)
        self._said = (folder / "said").open("w+")
        self.process = subprocess.Popen([program, str(master)], pass_fds=[master], stderr=self._said)
        os.close(master)

    def said(self, word: str) -> list[str]:
        self._said.seek(0)
        return [line.strip() for line in self._said if line.startswith(word)]

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self.slave)
        self._said.close()


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., object]:
    monkeypatch.setattr(mm_ard, "BOOT_S", 0.1)
    main = tmp_path / "main.cpp"
    main.write_text(f'#include "{Path(__file__).with_name("arduino.h")}"\n#include "{Path(SKETCH).resolve()}"\n')

    @contextmanager
    def run(*flags: str) -> Iterator[Board]:
        program = tmp_path / "firmware"
        subprocess.run(["g++", "-O1", "-w", "-fpermissive", *flags, "-o", program, main], check=True)
        board = Board(program, tmp_path)
        try:
            yield board
        finally:
            board.close()

    return run


def connect(board: Board) -> mm_ard.MirrorBoard:
    return mm_ard.MirrorBoard(Link(board.url, mm_ard.BAUD, "mirror board", WallClock()))


def test_our_driver_draws_with_it(start: Callable[..., Iterator[Board]]) -> None:
    """300 spots: what the firmware shifts out to its DAC, and its lines, are those that were asked for."""
    rng = random.Random(1)
    spots = [(rng.randrange(4096), rng.randrange(4096)) for _ in range(300)]
    with start("-DTLV5618") as board:  # type: ignore[attr-defined]
        driver = connect(board)
        for i, (u, v) in enumerate(spots):
            driver.set_mirrors(u, v)
            driver.set_lines(1 << i % 6)
            assert driver.counts(i % 6) == 1000 - 100 * (i % 6)
            driver.shut()
        driver.close()
        words = [word for word, _ in groupby(board.said("DAC"))]  # a busy machine is slow to answer: the driver repeats
        assert words == [f"DAC {axis} {x}" for spot in spots for axis, x in zip("AB", spot, strict=True)]
        assert board.said("TTL") == [f"TTL {x}" for i in range(300) for x in (1 << i % 6, 0)]


def test_a_shut_is_understood_in_the_middle_of_any_command(start: Callable[..., Iterator[Board]]) -> None:
    with start("-DTLV5618") as board:  # type: ignore[attr-defined]
        driver = connect(board)
        for unfinished in (b"", b"\1", b"\3", b"\3\0", b"\3\0\1", b"\x16", b"\x29"):
            driver.set_lines(0b11)
            driver.link.write(unfinished)
            driver.shut()
        assert set(board.said("TTL")) == {"TTL 3", "TTL 0"}
        driver.close()


def test_a_board_without_a_dac_is_refused(start: Callable[..., Iterator[Board]]) -> None:
    with start() as board, pytest.raises(WrongDevice, match="built for 0 DAC channels"):  # type: ignore[attr-defined]
        connect(board)


def test_the_emulated_board_answers_as_it_does(start: Callable[..., Iterator[Board]]) -> None:
    """2000 random commands, known and unknown: the same bytes come back, the same lines and DAC values are left."""
    rng = random.Random(2)
    unknown = [x for x in range(256) if x not in COMMANDS + NOT_EMULATED]
    head = MirrorHead(sample=lambda pin: 1000 - 100 * pin)
    emulated = MmArdFirmware(head)
    with start("-DTLV5618") as board:  # type: ignore[attr-defined]
        for i in range(2000):
            command = rng.choice((*COMMANDS, rng.choice(unknown)))
            top = 8 if command == 41 else 256
            sent = bytes([command, *(rng.randrange(top) for _ in range(ARGUMENTS.get(command, 0)))])
            expected = b"".join(data for _, data in emulated.feed(sent, 10.0 + 10.0 * i))
            os.write(board.slave, sent)
            got = b""
            while len(got) < len(expected) and select.select([board.slave], [], [], 2.0)[0]:
                got += os.read(board.slave, 100)
            assert got == expected, sent
        assert not select.select([board.slave], [], [], 0.1)[0]  # silence was silence
        last = {line.split()[1]: int(line.split()[2]) for line in board.said("DAC")}
        assert [last["A"], last["B"]] == [galvo.target for galvo in head.galvos]
        assert board.said("TTL")[-1] == f"TTL {head.lines}"
