"""The supervisor as it is, which also notes when the commands for darkness leave it: `time url`, a line each.

So `benchmarks.laser_safety` can tell its own time from that of the emulated devices.
"""

from __future__ import annotations

import os
import time
from contextlib import suppress

from hw.safety import supervisor
from hw.safety.supervised_device import SupervisedDevice

STAMPS = "DISCO_TWIN_STAMPS"  # in the environment: the file


class TimedDevice(SupervisedDevice):
    """A device whose commands for darkness are noted, by the program's own hand or the supervisor's."""

    def _write(self, data: bytes) -> bytes:
        left = super()._write(data)
        if self.kind.off in data:
            # The benchmark may be over: a note that cannot be kept must not be taken for a lost port.
            with suppress(OSError), open(os.environ[STAMPS], "a", encoding="ascii") as file:
                file.write(f"{time.monotonic()} {self.url}\n")
        return left


if __name__ == "__main__":
    setattr(supervisor, "SupervisedDevice", TimedDevice)  # noqa: B010 - a spy on its devices
    supervisor.main()
