"""Omicron's ASCII protocol: frames, status and mode bits, failures. `hw.devices.omicron` is the driver."""

from __future__ import annotations

from enum import IntFlag

USB_BAUD = 500_000
LEVELS = 0xFFF  # of SLP and GLP: 100 %


class Status(IntFlag):
    """GAS."""

    ERROR = 1 << 0
    ON = 1 << 1
    PREHEAT = 1 << 2
    ATTENTION = 1 << 4
    ENABLE_PIN = 1 << 6
    KEY = 1 << 7
    TOGGLE_KEY = 1 << 8
    POWERED = 1 << 9


class Mode(IntFlag):
    """GOM and SOM."""

    BIAS = 1 << 3
    RELEASE = 1 << 4
    DIGITAL = 1 << 5
    ANALOG = 1 << 7
    APC = 1 << 8
    ADHOC = 1 << 13
    AUTOSTART = 1 << 14
    AUTO_POWERUP = 1 << 15


FAULTS = {  # GFB and GLF
    0: "the soft interlock is set (only a reset clears it)",
    4: "the CDRH box is missing or not allowed",
    5: "no communication with the head",
    6: "relay K1 failed",
    8: "the supply voltage is out of range",
    9: "the interlock is open",
    10: "the diode's current is too high",
    11: "the ambient temperature is out of range",
    12: "the diode's temperature is out of range",
    14: "an internal error occurred",
    15: "the diode's power is too high",
}


class OmicronFramer:
    """Answers (`!...`) without their CR; `$...` messages, NULs and whatever precedes the `!` are dropped.

    A `$` message may break into the middle of an answer. Dropped messages are kept in `notices` until they are taken.
    """

    def __init__(self) -> None:
        self._notice: bytearray | None = None  # a `$` message that has begun
        self._line = bytearray()
        self.notices: list[str] = []

    def reset(self) -> None:
        """Forget an unfinished message."""
        self._notice = None
        self._line.clear()

    def feed(self, data: bytes) -> list[str]:
        """The answers that end in these bytes."""
        answers = []
        for byte in data:
            if self._notice is not None:
                if byte == 0x0D:
                    self.notices.append(self._notice.decode("latin-1"))
                    self._notice = None
                else:
                    self._notice.append(byte)
            elif byte == ord("$"):
                self._notice = bytearray()
            elif byte == 0x0D:
                start = self._line.rfind(b"!")
                if start >= 0:
                    answers.append(self._line[start:].decode("latin-1"))
                self._line.clear()
            else:
                self._line.append(byte)
        return answers
