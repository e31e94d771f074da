"""Mirrors, laser gates and photodiode on one port: the Micro-Manager Arduino firmware ("MM-Ard", version 5).

Bytes, not text, at 57600 baud; facts from its source (mmCoreAndDevices, AOTFcontroller.ino). It has no frame, so the
driver keeps in step by counting: what is not the expected echo is answered by a pause longer than the firmware waits
for an argument (1 s), and a new beginning. Setting a value twice does no harm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hw.base.errors import DeviceRefused, Garbled, InputError, NoAnswer, WrongDevice
from hw.safety.signals import uninterrupted
from hw.serial.link import Inbox, Link, asked, persist

BAUD = 57_600
BOOT_S = 2.0  # opening the port resets the board
ANSWER_S = 0.2
FORGET_S = 1.1  # the firmware drops a command whose argument does not come within 1 s
STEPS = 4096  # of the 12-bit DAC
ADC_TOP = 1023
LINES = 6
PINS = 6
ATTEMPTS = 3
RESTART = bytes(3)  # ends whatever command is unfinished
IDENTITY = b"MM-Ard\r\n"

SET_LINES, GET_LINES, SET_DAC, NO_BLANKING, IDENTIFY, VERSION, CHANNELS, READ_PIN = 1, 2, 3, 21, 30, 31, 34, 41


class ByteFramer:
    """No frames at all: every byte is a message."""

    def feed(self, data: bytes) -> list[int]:
        """The bytes."""
        return list(data)

    def reset(self) -> None:
        """Nothing is kept."""


class MirrorBoard:
    """The board. Connecting shuts every line."""

    def __init__(self, link: Link) -> None:
        """Wait for the board to start, identify it, shut everything."""
        self.link = link
        self._inbox: Inbox[int] = Inbox(link, ByteFramer())
        self._owed = False  # an answer that was not waited for may still come
        self._lost: Callable[[], None] = lambda: None
        link.clock.sleep(BOOT_S)
        self.version = self._identify()
        self.shut()
        self._exchange(bytes([NO_BLANKING]), [NO_BLANKING])

    # ---- talking

    def _exchange(self, command: bytes, answer: Sequence[int | None]) -> bytes:
        """Send, and expect these bytes; tried again, since every command may be given twice.

        Several commands may be sent together, which saves a way to and fro for each: the board's buffer has 64 bytes.

        Returns: what came in the places of None.
        """

        def attempt() -> bytes:
            if self._owed:
                self._resynchronise()
            self._inbox.clear()
            self._owed = True
            self.link.write(command)
            got = self._receive(len(answer), command)
            if any(wanted not in (None, byte) for wanted, byte in zip(answer, got, strict=True)):
                expected = " ".join("--" if wanted is None else f"{wanted:02x}" for wanted in answer)
                problem = f"answered {command.hex(' ')} with {got.hex(' ')} instead of {expected}"
                raise self.link.error(Garbled, problem, "check cable and grounding of the board")
            self._owed = False
            return bytes(byte for wanted, byte in zip(answer, got, strict=True) if wanted is None)

        def recover() -> None:
            self._lost()
            self._resynchronise()

        return persist(attempt, recover)

    def _receive(self, size: int, command: bytes) -> bytes:
        end = self.link.clock.now() + ANSWER_S
        got = bytearray()
        while len(got) < size:
            byte = self._inbox.next(lambda _: True, end - self.link.clock.now())
            if byte is None:
                raise self.link.no_answer(command.hex(" "), ANSWER_S)
            got.append(byte)
        return bytes(got)

    def _resynchronise(self) -> None:
        """Whatever it was waiting for or about to say: after this the board listens for a command, and is silent."""
        self._inbox.drain(FORGET_S)
        self._owed = False

    # ---- identity

    def _identify(self) -> int:
        self._inbox.clear()
        try:
            self._exchange(bytes([IDENTIFY]), list(IDENTITY))
        except (NoAnswer, Garbled) as error:
            raise self.link.wrong_device(f"is not an MM-Ard board: asked {IDENTIFY}, {self.link.heard()}") from error
        version = self._line(VERSION)
        channels = self._exchange(bytes([CHANNELS]), [CHANNELS, None])[0] if version >= 5 else 0
        if channels < 2:
            problem = f"(MM-Ard version {version}) was built for {channels} DAC channels and would ignore the mirrors"
            remedy = "build AOTFcontroller.ino, version 5 or newer, with TLV5618 defined"
            raise self.link.error(WrongDevice, problem, remedy)
        return version

    def _line(self, command: int) -> int:
        """A number in text, ended by CR LF."""

        def once() -> bytes:
            self._inbox.clear()
            self.link.write(bytes([command]))
            text = self._receive(3, bytes([command]))
            while not text.endswith(b"\r\n"):
                text += self._receive(1, bytes([command]))
            return text

        return asked(self.link, str(command), once, int, self._resynchronise)

    # ---- what it does

    def when_lost(self, action: Callable[[], None]) -> None:
        """What to do when an answer was lost, before anything is repeated."""
        self._lost = action

    def set_mirrors(self, u: int, v: int) -> None:
        """DAC values 0 .. 4095 of both axes, one after the other: the beam draws an L, so the gates must be shut.

        Raises: InputError.
        """
        for channel, (name, value) in enumerate((("u", u), ("v", v))):
            if not 0 <= value < STEPS:
                raise InputError(
                    "no such mirror step",
                    key=name,
                    value=value,
                    allowed=f"0 to {STEPS - 1}",
                    remedy="aim at another one",
                )
            command = bytes([SET_DAC, channel, value >> 8, value & 0xFF])
            self._exchange(command, list(command))

    def set_lines(self, pattern: int) -> None:
        """The TTL lines as bits 0 .. 5; read back, since the echo does not contain them.

        Understood wherever in a command the board's parser is: the longest command takes three arguments, so three
        zeros end any unfinished one (with harmless values), and otherwise they are ignored.

        Raises: DeviceRefused where the board does not follow.
        """
        if not 0 <= pattern < 1 << LINES:
            raise InputError(
                "no such pattern of TTL lines",
                value=pattern,
                allowed=f"0 to {(1 << LINES) - 1}",
                remedy="set these lines alone",
            )
        if self._owed and not pattern:
            self.darken()  # getting back into step takes a second
        for _ in range(ATTEMPTS):
            command = bytes([*RESTART, SET_LINES, pattern, GET_LINES])
            found = self._exchange(command, [SET_LINES, GET_LINES, None])[0] & (1 << LINES) - 1
            if found == pattern:
                return
        if pattern:
            self.shut()
        problem = f"has its TTL lines at {found:06b} instead of {pattern:06b}"
        remedy = "switch the board off and on; blanking and trigger modes must be off"
        raise self.link.error(DeviceRefused, problem, remedy)

    def shut(self) -> None:
        """Every line low."""
        self.set_lines(0)

    def darken(self) -> None:
        """Send the command for every line low without waiting for anything, first of all when something is wrong."""
        self.link.write(bytes([*RESTART, SET_LINES, 0]))

    def lines(self) -> int:
        """The TTL lines as they are."""
        return self._exchange(bytes([GET_LINES]), [GET_LINES, None])[0] & (1 << LINES) - 1

    def counts(self, pin: int) -> int:
        """The 10-bit ADC's value at an analogue pin: the median of three readings.

        The protocol has no checksum: one garbled reading could not be told from a right one.

        Raises: InputError.
        """
        if not 0 <= pin < PINS:
            raise InputError("no such analogue pin", value=pin, allowed=f"0 to {PINS - 1}", remedy="read one of these")
        read = self._exchange(bytes([READ_PIN, pin] * 3), [READ_PIN, pin, None, None] * 3)
        return min(sorted(high << 8 | low for high, low in zip(read[::2], read[1::2], strict=True))[1], ADC_TOP)

    def close(self) -> None:
        """Shut every line as far as the board still listens, and give the port back; Ctrl-C waits until then."""
        with uninterrupted():
            try:
                self.shut()
            finally:
                self.link.close()
