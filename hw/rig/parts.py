"""The parts of a serial rig as `hw.interface` knows them: each asks the rig (`SerialRig`) for what it needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hw.base.errors import Refused
from hw.rig.emission import require_light

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
        return self.rig.file.lasers[self.index].wavelength_nm

    def open_gate(self) -> None:
        """Let light out; refused while another gate is open."""
        self.rig.require_guards()
        if self.rig.open_gate not in (-1, self.index):
            raise Refused(f"the gate of laser {self.rig.open_gate} is open: one laser at a time")
        self.rig.last_open = self.index
        self.rig.board().open_gate(self.rig.file.lasers[self.index].gate_line)

    def close_gate(self) -> None:
        """Shut this gate; always allowed."""
        if self.rig.open_gate == self.index:
            self.rig.board().switch(self.rig.file.lasers[self.index].gate_line, False)

    def darken(self) -> None:
        """Every gate and laser is told to go dark; closing the gate then confirms."""
        self.rig.darken()


@dataclass
class Mirrors:
    """The two mirrors."""

    rig: SerialRig

    def move(self, u: int, v: int) -> None:
        """Aim at mirror steps (u, v); returns when the mirrors have settled."""
        self.rig.require_dark("projector")
        self.rig.board().aim(u, v)


@dataclass
class SafeTurntable:
    """The turntable, which stands still while a gate is open."""

    rig: SerialRig

    def move(self, angle_rad: float) -> None:
        """Turn to an angle; returns when the table stands still."""
        self.rig.require_dark("turntable")
        self.rig.drivers().table.move(angle_rad)


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
        device = self.rig.file.lasers[laser]
        counts = board.counts(device.photodiode_pin)
        if self.rig.open_gate == laser:
            return require_light(counts, device)
        return counts * device.watts_per_count


@dataclass
class TtlFloodlight:
    """The spotlights that fully illuminate the object for a silhouette image, on a TTL line of the board."""

    rig: SerialRig

    def on(self) -> None:
        """Switch on."""
        self.rig.board().switch(self.rig.file.board.floodlight_line, True)

    def off(self) -> None:
        """Switch off; always allowed. Refuses the image if the light had gone out before."""
        if not self.rig.connected:
            return
        board, line = self.rig.board(), self.rig.file.board.floodlight_line
        try:
            if board.lit(line):
                board.require_lines()
        finally:
            board.switch(line, False)
