"""The twin does as real devices do, so that simulated cameras see it: a real turntable turns the simulated object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from disco_twin.emulation.bench import Bench
from disco_twin.firmware.turning import Spindle
from hw.devices.omicron_protocol import Mode
from hw.rig.limits import Subscriber


@dataclass
class MirroredDevices(Subscriber):
    """The bench of emulated devices, each in the state that the real one was put into."""

    bench: Bench

    def laser(self, index: int, power_mw: float) -> None:
        """The twin's laser emits this power, as long as it takes the real one to be steady behind it."""
        head = self.bench.heads[index]
        head.level, head.mode = power_mw / head.max_power_mw, int(Mode.BIAS | Mode.RELEASE)
        head.on_since = -np.inf if power_mw else None

    def mirrors(self, u: int, v: int) -> None:
        """The twin's mirrors go there."""
        for channel, value in enumerate((u, v)):
            self.bench.board.write(channel, value, self.bench.clock.now())

    def lines(self, pattern: int) -> None:
        """The twin's gates and lamps, too."""
        self.bench.board.set_pattern(pattern)

    def turntable(self, angle_rad: float) -> None:
        """The twin's object stands there."""
        angle_deg = float(np.rad2deg(angle_rad))
        self.bench.spindle = Spindle(angle_deg=angle_deg, homed=True, on_move=self.bench.turned)
        self.bench.turned(angle_deg)
