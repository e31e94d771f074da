"""The parts of a serial rig as `hw.interface` knows them: each asks the rig (`SerialRig`) for what it needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hw.base.errors import DeviceFault, Refused
from hw.devices.mm_ard import ADC_TOP

if TYPE_CHECKING:
    from hw.rig.serial_rig import SerialRig


@dataclass
class GatedLaser:
    """One laser behind its gate."""

    rig: SerialRig
    index: int

    @property
    def wavelength_nm(self) -> float:
        """Nominal wavelength."""
        return self.rig.wiring[self.index].wavelength_nm

    def open_gate(self) -> None:
        """Let light out; refused while another gate is open."""
        self.rig.require_guards()
        if self.rig.open_gate not in (-1, self.index):
            raise Refused(f"the gate of laser {self.rig.open_gate} is open: one laser at a time")
        self.rig.last_open = self.index
        self.rig.board().open_gate(self.rig.wiring[self.index].gate_line)

    def close_gate(self) -> None:
        """Shut this gate; always allowed."""
        if self.rig.open_gate == self.index:
            self.rig.board().switch(self.rig.wiring[self.index].gate_line, False)

    def darken(self) -> None:
        """Every gate and laser is told off; closing the gate then confirms."""
        self.rig.cut()


@dataclass
class Mirrors:
    """The two mirrors."""

    rig: SerialRig

    def move(self, u: int, v: int) -> None:
        """Aim at mirror steps (u, v); returns when the mirrors have settled."""
        self.rig.require_dark("projector")
        self.rig.board().aim(u, v)


@dataclass
class Turning:
    """The turntable."""

    rig: SerialRig

    def move(self, angle_rad: float) -> None:
        """Turn to an angle; returns when the table stands still."""
        self.rig.require_dark("turntable")
        self.rig.devices().table.move(angle_rad)


@dataclass
class AdcPhotodiode:
    """The photodiode of the laser that was opened last, by the board's 10-bit converter."""

    rig: SerialRig

    def read(self) -> float:
        """Watts on the object; refused when they are not those that the laser was set to."""
        self.rig.require_guards()
        laser, board = self.rig.last_open, self.rig.board()
        if laser < 0:
            return 0.0
        board.require_lines()
        wiring = self.rig.wiring[laser]
        counts = board.counts(wiring.pin)
        watts = counts * wiring.watts_per_count
        low, high = wiring.limits
        if self.rig.open_gate == laser and (counts >= ADC_TOP or not low <= watts / (wiring.power_mw * 1e-3) <= high):
            head = self.rig.devices().heads[laser]
            problem = f"gives {1e3 * watts:.2f} mW at the photodiode instead of {wiring.power_mw:g} mW"
            if counts >= ADC_TOP:
                problem += " (the converter is at its top)"
            remedy = "check the laser's interlock, the gate and the photodiode's gain"
            raise DeviceFault(f"pin {wiring.pin}", head.name, problem, remedy)
        return watts


@dataclass
class TtlFloodlight:
    """The spotlights that fully illuminate the object for a silhouette image, on a TTL line of the board."""

    rig: SerialRig

    def on(self) -> None:
        """Switch on."""
        self.rig.devices()
        if self.rig.flood_line is None:
            raise Refused("this rig has no floodlight: name its TTL line in the rig file")
        self.rig.board().switch(self.rig.flood_line, True)

    def off(self) -> None:
        """Switch off; always allowed. Refuses the image if the light had gone out before."""
        line = self.rig.flood_line
        if line is None or not self.rig.connected:
            return
        board = self.rig.board()
        try:
            if board.lit(line):
                board.require_lines()
        finally:
            board.switch(line, False)
