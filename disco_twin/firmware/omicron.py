"""The firmware of an Omicron laser: what the head does (`LaserHead`), and how it is spoken to (`OmicronFirmware`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from disco_twin.firmware.wire import LineFirmware, Timed
from hw.devices.omicron_protocol import LEVELS, USB_BAUD, Mode, Status

LATENCY_S = 0.015
EMISSION_S = 3.0  # from LOn to light
RESET_S = 5.0
SOFT_INTERLOCK, INTERLOCK = 1 << 0, 1 << 9  # of GFB
FACTORY_MODE = Mode.BIAS | Mode.RELEASE | Mode.ADHOC
PRESETS = {0: Mode(0), 1: Mode.BIAS | Mode.RELEASE, 2: Mode.BIAS | Mode.RELEASE | Mode.APC}
KEPT_BY_PRESETS = Mode.ADHOC | Mode.AUTOSTART | Mode.AUTO_POWERUP


@dataclass
class LaserHead:
    """State of one laser. `stored_*` survive a power cut; times are on the injected clock.

    `on_start` is called at every LOn that starts a laser which was off.
    """

    wavelength_nm: float
    max_power_mw: float
    model: str = "LuxX"
    device_id: int = 4
    serial_number: str = "4711"
    knows_temporary_power: bool = True
    stored_level: int = 0
    stored_mode: int = int(FACTORY_MODE)
    key: bool = True
    interlock_closed: bool = True
    enabled: bool = True
    memory_writes: int = 0
    on_start: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        self.start(0.0)
        self.latched = 0

    def start(self, now: float) -> None:
        """Power-on, or the end of a reset: settings come from memory, failures that have gone are cleared."""
        self.mode = self.stored_mode
        self.level = self.stored_level / LEVELS
        self.failures = 0 if self.interlock_closed else INTERLOCK | SOFT_INTERLOCK
        self.toggle_key = False
        self.powered = True
        self.restarted_until = now
        self.on_since: float | None = None
        if self.mode & Mode.AUTOSTART and self.key and not self.failures:
            self.on_since = now

    # ---- what happens to it

    def set_interlock(self, closed: bool) -> None:
        """Open: light off at once, and a failure that outlives the cause until a reset."""
        self.interlock_closed = closed
        if closed:
            self.failures &= ~INTERLOCK
        else:
            self.fail(INTERLOCK | SOFT_INTERLOCK)

    def set_key(self, on: bool) -> None:
        """Off: light off at once; back on, the key has been toggled."""
        self.key = on
        if not on:
            self.on_since, self.toggle_key = None, True
        else:
            self.toggle_key = False

    def fail(self, bits: int) -> None:
        """A failure of any kind ends emission."""
        self.failures |= bits
        self.latched |= bits
        self.on_since = None

    # ---- what it does

    def switch_on(self, now: float) -> bool:
        """LOn. Refused with a failure, a turned key, without power."""
        if self.failures or not self.key or not self.enabled or not self.powered or self.toggle_key:
            return False
        if self.on_since is None:
            self.on_since = now
            self.on_start()
        return True

    def lit(self, now: float) -> bool:
        """Whether the diode is past its preheating."""
        return self.on_since is not None and now >= self.on_since + EMISSION_S and now >= self.restarted_until

    def emission(self, now: float) -> float:
        """Light that leaves the head, as a share of the maximum power."""
        released = self.mode & Mode.BIAS and self.mode & Mode.RELEASE
        return self.level if self.lit(now) and released and self.enabled else 0.0

    def status(self, now: float) -> Status:
        """GAS."""
        return (
            (Status.ERROR if self.failures else Status(0))
            | (Status.ON if self.lit(now) else Status(0))
            | (Status.PREHEAT if self.on_since is not None and not self.lit(now) else Status(0))
            | (Status.ENABLE_PIN if self.enabled else Status(0))
            | (Status.KEY if self.key else Status(0))
            | (Status.TOGGLE_KEY if self.toggle_key else Status(0))
            | (Status.POWERED if self.powered else Status(0))
        )


class OmicronFirmware(LineFirmware):
    """The parser: `?` letters arguments CR. Silent while it restarts."""

    def __init__(self, head: LaserHead, baud: int = USB_BAUD) -> None:
        super().__init__(b"\r")
        self.head, self.baud = head, baud
        self._separator = "\xa7"

    def power_cycle(self, now: float) -> None:
        """Settings from memory; the separator is the factory's again."""
        super().power_cycle(now)
        self._separator = "\xa7"
        self.head.start(now)

    def answers(self, command: str, now: float) -> list[Timed]:
        """None while it restarts."""
        heard = command.startswith("?") and now >= self.head.restarted_until
        return self._answer(command[1:4], command[4:], now) if heard else []

    def _answer(self, letters: str, arguments: str, now: float) -> list[Timed]:
        if letters == "RsC":
            self.power_cycle(now)
            self.head.on_since, self.head.restarted_until = None, now + RESET_S
            return [(LATENCY_S, b"!RsC\r"), (RESET_S, b"\0$RsC>\r")]
        command = COMMANDS.get(letters)
        known = command is not None and (letters != "TPP" or self.head.knows_temporary_power)
        if command is None or not known:
            return [(LATENCY_S, b"!UK\r")]
        if letters == "GFw" and arguments == "|":
            self._separator = "|"
        try:
            data = command(self.head, arguments, now).replace("\xa7", self._separator)
        except ValueError:
            data = "x"
        return [(LATENCY_S, f"!{letters}{data}\r".encode("latin-1"))]


# ---- commands: head, arguments, time -> data of the answer; ValueError: refused

Command = Callable[[LaserHead, str, float], str]


def _hexadecimal(text: str, digits: int) -> int:
    if len(text) != digits:
        raise ValueError(text)
    return int(text, 16)


def _store_level(head: LaserHead, arguments: str, now: float) -> str:
    value = _hexadecimal(arguments, 3)
    head.stored_level, head.level, head.memory_writes = value, value / LEVELS, head.memory_writes + 1
    return ">"


def _temporary_power(head: LaserHead, arguments: str, now: float) -> str:
    percent = float(arguments)
    if not 0.0 <= percent <= 100.0:
        return "x"
    head.level = percent / 100.0
    return ">"


def _light_off(head: LaserHead, arguments: str, now: float) -> str:
    head.on_since = None
    return ">"


def _power(head: LaserHead, on: bool) -> str:
    head.powered = on
    if not on:
        head.on_since = None
    return ">"


def _set_mode(head: LaserHead, arguments: str, now: float) -> str:
    head.mode = head.stored_mode = _hexadecimal(arguments, 4)
    return ">"


def _recall_mode(head: LaserHead, arguments: str, now: float) -> str:
    if not arguments:
        bits = head.mode & ~KEPT_BY_PRESETS
        return str(next((n for n, preset in PRESETS.items() if preset == bits), 3))
    preset = PRESETS.get(int(arguments))
    if preset is None:
        return "x"
    return _set_mode(head, f"{head.mode & KEPT_BY_PRESETS | preset:04X}", now)


def _autostart(head: LaserHead, arguments: str, now: float) -> str:
    if not arguments:
        return str(int(bool(head.mode & Mode.AUTOSTART)))
    bit = {"0": 0, "1": int(Mode.AUTOSTART)}.get(arguments)
    return "x" if bit is None else _set_mode(head, f"{head.mode & ~Mode.AUTOSTART | bit:04X}", now)


COMMANDS: dict[str, Command] = {
    "GFw": lambda head, _, now: f"{head.model}\xa7{head.device_id}\xa71.90",
    "GSN": lambda head, _, now: head.serial_number,
    "GSI": lambda head, _, now: f"{head.wavelength_nm:g}\xa7{head.max_power_mw:g}",
    "GMP": lambda head, _, now: f"{head.max_power_mw:g}",
    "GWH": lambda head, _, now: "123",
    "SLP": _store_level,
    "GLP": lambda head, _, now: f"{round(head.level * LEVELS):03X}",
    "TPP": _temporary_power,
    "MDP": lambda head, _, now: f"{head.emission(now) * head.max_power_mw:.4f}",
    "MTD": lambda head, _, now: "25.1",
    "MTA": lambda head, _, now: "x",
    "LOn": lambda head, _, now: ">" if head.switch_on(now) else "x",
    "LOf": _light_off,
    "POn": lambda head, _, now: _power(head, True),
    "POf": lambda head, _, now: _power(head, False),
    "SAS": _autostart,
    "ROM": _recall_mode,
    "GOM": lambda head, _, now: f"{head.mode:04X}",
    "SOM": _set_mode,
    "GAS": lambda head, _, now: f"{int(head.status(now)):04X}",
    "GFB": lambda head, _, now: f"{head.failures:04X}",
    "GLF": lambda head, _, now: f"{head.latched:04X}",
}
