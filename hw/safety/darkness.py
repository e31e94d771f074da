"""How a device is made dark: the bytes that put its light out, and the answers that count as its confirmation.

A kind's `confirmed` asks for darkness once and is true if the device confirms. It is a generator, since asking takes
time in which other devices are asked, too: `yield from ask(command, answer)` sends a command and waits for what
`answer` finds in all bytes that have come since; None if nothing is found in time.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Generator
from dataclasses import dataclass

Ready = set[int]  # descriptors that can be read
Answer = Callable[[bytes], bytes | None]
Ask = Callable[[bytes, Answer], Generator[None, Ready, bytes | None]]
Confirmed = Generator[None, Ready, bool]

ON_OR_PREHEATING = 1 << 1 | 1 << 2  # of GAS; a laser that preheats emits some seconds later


@dataclass(frozen=True)
class Kind:
    """A kind of device.

    off: what puts its light out, whatever the program had begun to say to it; lights: found in what a program says
    when it lets light out; warning: to the user where the device does not confirm
    """

    off: bytes
    lights: re.Pattern[bytes]
    warning: str
    confirmed: Callable[[Ask], Confirmed]


def _omicron(letters: bytes) -> Answer:
    """The data of a laser's answer to these letters; messages that begin with `$`, and NULs, are taken out."""
    answer = re.compile(b"!" + letters + rb"([^\r]+)\r")

    def find(heard: bytes) -> bytes | None:
        found = answer.search(re.sub(rb"\$[^\r]*\r", b"", heard).replace(b"\0", b""))
        return found and found[1]

    return find


def _laser(ask: Ask) -> Confirmed:
    """LOf is confirmed, and the status says that the laser neither emits nor is about to."""
    done = yield from ask(LASER.off, _omicron(b"LOf"))
    if done is None:
        return False  # told again at once
    yield from ask(b"?TPP0.00000\r", _omicron(b"TPP"))  # no power and no autostart: it stays off
    yield from ask(b"?SAS0\r", _omicron(b"SAS"))
    status = yield from ask(b"?GAS\r", _omicron(rb"GAS(?=[0-9A-Fa-f]{1,4}\r)"))
    return done == b">" and status is not None and not int(status, 16) & ON_OR_PREHEATING


def _board(ask: Ask) -> Confirmed:
    """The lines are read back as low."""
    yield from ask(BOARD.off, lambda heard: None)  # nothing that comes in this time answers what is asked next
    lines = yield from ask(bytes([2]), lambda heard: heard[1:] if len(heard) == 2 and heard[0] == 2 else None)
    return lines is not None and not lines[0] & 0b111111


# The CR ends a command that was begun; so do three zeros, since no command of the board takes more arguments.
LASER = Kind(b"\r?LOf\r", re.compile(rb"LOn"), "THE LASER DOES NOT CONFIRM THAT IT IS OFF", _laser)
BOARD = Kind(bytes([0, 0, 0, 1, 0]), re.compile(rb"\x01[\x01-\x3f]"),
             "THE BOARD DOES NOT CONFIRM THAT GATES AND LAMPS ARE OFF", _board)  # fmt: skip
KINDS = {"board": BOARD, "laser": LASER}  # in the order in which they are told
