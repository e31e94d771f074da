"""The byte log: every byte to and from a device with its time, appended as it happens, and replayed as a test.

One line an event: seconds, `open`, `>` (to the device), `<` (from it), `!` (an error) or `close`, and the bytes in
hex. The first line of a file names the format. A log that a bench has recorded replays as a test
(`tests/support/replay.py`): the same driver must send the same bytes, and gets the answers that were recorded.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from hw.base.errors import InputError

log = logging.getLogger(__name__)

HEADER = "disco-twin byte log, format_version 1"


@dataclass(frozen=True)
class Event:
    """Something that happened on a port."""

    time_s: float
    mark: str
    data: bytes

    def __str__(self) -> str:
        return f"{self.time_s:.6f} {self.mark} {self.data.hex()}".rstrip()


class ByteLog:
    """Appends to a file, line by line, flushed: it is complete up to the moment of a crash.

    A log that cannot be written any more (a full disk) ends with one warning: the device goes on without it.

    Raises: InputError where the file cannot be begun.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._failed = path, False
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("a", encoding="ascii", buffering=1)
            if self._file.tell() == 0:
                self._file.write(HEADER + "\n")
        except OSError as error:
            problem = f"cannot be written ({error.strerror})"
            raise InputError(problem, file=path, remedy="choose another folder for the byte logs") from error

    def note(self, time_s: float, mark: str, data: bytes) -> None:
        """Add an event."""
        if self._failed:
            return
        try:
            self._file.write(f"{Event(time_s, mark, data)}\n")
        except OSError as error:
            self._give_up(error)

    def close(self) -> None:
        """End the log."""
        try:
            self._file.close()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        if not self._failed:
            log.warning("%s: the byte log ends here (%s)", self.path, error.strerror)
        self._failed = True
