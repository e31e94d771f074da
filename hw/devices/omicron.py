"""Omicron lasers (PhoxX, LuxX, LuxX+): the ASCII protocol over USB (500000 baud) or RS-232 (57600).

`?` + three letters + arguments + CR is answered by `!` + the same letters + data + CR; a setting by `>` (done) or `x`
(refused), an unknown command by `!UK`. Messages that begin with `$` come whenever the laser likes, NUL bytes too.
Facts: Micro-Manager's Omicron adapter and Odemis's omicronxx driver. There is no host watchdog: a laser that was told
to emit does so until it is told otherwise.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NoReturn, TypeVar

from hw.base.errors import DeviceError, DeviceFault, DeviceRefused, NoAnswer
from hw.devices.omicron_protocol import FAULTS, LEVELS, Mode, OmicronFramer, Status
from hw.safety.signals import uninterrupted
from hw.serial.link import Inbox, Link, asked

log = logging.getLogger(__name__)

T = TypeVar("T")

MODELS = {3: "PhoxX", 4: "LuxX", 18: "LuxX+"}
ANSWER_S = 0.5
ATTEMPTS = 3
EMISSION_S = 8.0  # LOn takes about 3 s
RESET_S = 12.0  # RsC takes about 5 s
POLL_S = 0.1
OFF_S = 1.0  # from LOf until the laser's own reading has fallen
OFF_SHARE = 0.01  # of the maximum power: offset of the laser's own photodiode
WAVELENGTH_TOLERANCE_NM = 10.0
SEPARATOR = re.compile("[|\xa7]")  # 0xA7, or `|` after ?GFw|
SAFE_OFF = Mode.BIAS | Mode.RELEASE | Mode.AUTOSTART  # cleared whenever the laser is not to emit
SOFTWARE_ONLY = Mode.DIGITAL | Mode.ANALOG | Mode.ADHOC  # cleared, so that nothing but these commands drives the laser
PROBES = ("GFw", "GSN", "GMP")  # harmless questions, to see where in the stream of answers we are


@dataclass(frozen=True)
class LaserIdentity:
    """What a laser reports of itself."""

    model: str
    firmware: str
    serial_number: str
    wavelength_nm: float
    max_power_mw: float


class OmicronLaser:
    """One laser. Connecting switches it off; `arm` and `emit` are needed before light leaves it."""

    def __init__(
        self, link: Link, wavelength_nm: float, subscriber: Callable[[float], None] = lambda power_mw: None
    ) -> None:
        """Identify and switch off.

        wavelength_nm: of the laser that the rig expects at this port; subscriber: is given the power at every beginning
        of emission, and 0 whenever the laser is told to go dark

        Raises: WrongDevice; DeviceFault where the laser does not go off.
        """
        self.link, self.name, self.framer, self._subscriber = link, link.device, OmicronFramer(), subscriber
        self._inbox: Inbox[str] = Inbox(link, self.framer)
        self._owed: set[str] = set()  # questions whose answer may still come
        self._silent = False  # it answered none of the questions that were to bring us back into step
        self._temporary_power = True  # TPP is known, as far as we know
        self.identity = self._identify(wavelength_nm)
        self.armed_mw = 0.0
        self.force_off()
        self.require_off()

    # ---- talking

    def ask(self, letters: str, arguments: str = "") -> str:
        """The data of the answer. For what may be asked twice: reading, and setting to a value."""
        return self._ask(letters, arguments, str)

    def _ask(self, letters: str, arguments: str, parse: Callable[[str], T]) -> T:
        """Ask until the answer can be parsed (ValueError: it cannot)."""

        once = partial(self._once, letters, arguments)
        return asked(self.link, f"?{letters}{arguments}", once, parse, self._resynchronise)

    def _once(self, letters: str, arguments: str = "") -> str:
        """Ask once. Only an answer with the same letters counts."""
        if self._owed:
            self._resynchronise()
        self._inbox.clear()
        self.link.write(f"?{letters}{arguments}\r".encode("latin-1"))
        self._owed.add(letters)
        answer = self._inbox.next(_begins("!" + letters, "!UK"), ANSWER_S)
        if answer is None:
            raise self.link.no_answer(f"?{letters}{arguments}", ANSWER_S)
        self._owed.discard(letters)
        self._silent = False
        if answer.startswith("!UK"):
            raise self.link.error(DeviceRefused, f"does not know ?{letters}{arguments}", "a laser of another kind?")
        return answer[1 + len(letters) :]

    def _resynchronise(self) -> None:
        """Answers come in order: once a probe that is owed nothing is answered, no older answer can come any more."""
        for probe in [p for p in PROBES if p not in self._owed]:
            self._inbox.clear()
            self.link.write(f"?{probe}\r".encode("latin-1"))
            self._owed.add(probe)
            if self._inbox.next(_begins("!" + probe), ANSWER_S) is not None:
                self._owed.clear()
                self._silent = False
                return
        self._silent = True
        self._inbox.drain(quiet_s=1.0)
        self._owed.clear()

    def _set(self, letters: str, arguments: str = "") -> None:
        """Set to a value; done twice if the answer is lost."""
        if self._ask(letters, arguments, _done_or_refused) == "x":
            self._refuse(f"refused ?{letters}{arguments}")

    def _number(self, letters: str) -> float:
        return self._ask(letters, "", float)

    def _bits(self, letters: str) -> int:
        return self._ask(letters, "", lambda answer: int(answer, 16))

    def _refuse(self, what: str) -> NoReturn:
        """Raise the reason why the laser does not do what it was asked for."""
        faults = self.faults()
        if faults:
            raise self.link.error(DeviceFault, f"{what}: {'; '.join(faults)}", "remove the cause, then reset")
        raise self.link.error(DeviceRefused, what, "check key switch, interlock and enable pin")

    # ---- identity

    def _identify(self, wavelength_nm: float) -> LaserIdentity:
        expected = f"an Omicron laser of {wavelength_nm:g} nm"
        try:
            answer = self.ask("GFw")
        except (NoAnswer, DeviceRefused) as error:
            raise self.link.wrong_device(f"is not {expected}: asked ?GFw, {self.link.heard()}") from error
        fields = SEPARATOR.split(answer)
        if len(fields) < 3 or not fields[1].isdigit() or int(fields[1]) not in MODELS:
            raise self.link.wrong_device(f"is not {expected}: ?GFw was answered by {answer[:40]!r}")
        found_nm = self._ask("GSI", "", lambda answer: float(SEPARATOR.split(answer)[0]))
        if abs(found_nm - wavelength_nm) > WAVELENGTH_TOLERANCE_NM:
            raise self.link.wrong_device(f"is not {expected}: a {MODELS[int(fields[1])]} of {found_nm:g} nm answered")
        return LaserIdentity(MODELS[int(fields[1])], fields[2], self.ask("GSN"), found_nm, self._number("GMP"))

    # ---- state

    def status(self) -> Status:
        """What the laser is doing."""
        return Status(self._bits("GAS"))

    def mode(self) -> Mode:
        """How the laser is driven."""
        return Mode(self._bits("GOM"))

    def faults(self) -> list[str]:
        """The present failures, in words; read twice, since a garbled bit must not stop a scan."""
        first, second = self._bits("GFB"), self._bits("GFB")
        return [text for bit, text in FAULTS.items() if first & second & 1 << bit]

    def measured_mw(self) -> float:
        """Power by the laser's own photodiode, in mW."""
        return self._number("MDP")

    def require_ready(self) -> None:
        """Refuse to go on with an open interlock, a turned key or any failure. Raises: DeviceFault."""
        faults = self.faults()
        if faults:
            remedy = "remove the cause, then `reset` the laser or switch it off and on"
            raise self.link.error(DeviceFault, "cannot emit: " + "; ".join(faults), remedy)
        status = self.status()
        for bad, problem, remedy in (
            (Status.TOGGLE_KEY in status, "waits for its key", "turn the key switch off and on"),
            (Status.KEY not in status, "is locked by its key", "turn the key switch on"),
            (Status.ENABLE_PIN not in status, "is locked by its enable pin", "press the laser's shutter button"),
        ):
            if bad:
                raise self.link.error(DeviceFault, problem, remedy)

    # ---- power and emission

    def force_off(self) -> None:
        """No light, now and after a power cut: LOf, power 0, no autostart, operating release and bias off.

        What the laser does not obey, or cannot, keeps it from none of the others. One that answers nothing is left to
        the supervisor, which insists: each of its questions would be waited for for nine seconds.
        """
        self.armed_mw = 0.0
        failed: list[DeviceError] = []
        steps: tuple[Callable[[], None], ...] = (
            lambda: self._set("LOf"),
            lambda: self._set_power(0.0),
            lambda: self._set("SAS", "0"),
            lambda: self._set_mode(clear=SAFE_OFF | SOFTWARE_ONLY),
        )
        for step in steps:
            try:
                step()
            except DeviceError as error:  # the other steps may still get through
                failed.append(error)
                if self._silent:
                    break
        self._subscriber(0.0)
        if failed:
            raise failed[0]

    def require_off(self) -> float:
        """Its own reading in mW, dark twice in a row; refused where it reports that it emits, or measures light.

        That a command was answered is no proof that it was obeyed.

        Raises: DeviceFault.
        """
        clock, most = self.link.clock, OFF_SHARE * self.identity.max_power_mw
        end, dark = clock.now() + OFF_S, 0
        while True:
            status, measured = self.status(), self.measured_mw()
            dark = dark + 1 if not status & (Status.ON | Status.PREHEAT) and abs(measured) <= most else 0
            if dark == 2:
                return measured
            if clock.now() > end:
                said = "on" if Status.ON in status else "preheating" if Status.PREHEAT in status else "off"
                problem = (
                    f"was told to go off, reports that it is {said} and measures {measured:.2f} mW (allowed: {most:g})"
                )
                raise self.link.error(DeviceFault, problem, "switch it off by its key and have it serviced")
            clock.sleep(POLL_S)

    def arm(self, power_mw: float) -> None:
        """Allow light of this power; none leaves the laser before `emit`. Raises: DeviceRefused, DeviceFault."""
        top = self.identity.max_power_mw
        if not 0.0 < power_mw <= top * (1.0 + 1e-9):
            problem = f"cannot be set to {power_mw:g} mW"
            raise self.link.error(DeviceRefused, problem, f"ask for more than 0 and at most {top:g} mW")
        if self.faults() == [FAULTS[0]]:  # an interlock was open and is closed again; whoever arms it asks anew
            log.warning("%s: %s; resetting it", self.name, FAULTS[0])
            self.reset()
        self.require_ready()
        self._set("POn")
        self._set_power(min(1.0, power_mw / top))
        self._set_mode(add=Mode.BIAS | Mode.RELEASE)
        self.armed_mw = power_mw

    def emit(self) -> None:
        """Start emission; returns once the laser reports that it is on. Its gate must be shut.

        Raises: DeviceRefused, NoAnswer.
        """
        if not self.armed_mw:
            raise self.link.error(DeviceRefused, "is not armed", "arm it with a power before it may emit")
        try:
            answer = self._once("LOn")
        except NoAnswer:  # not sent again: the status shows whether it was understood
            log.warning("%s: the answer to LOn was lost; asking for the status instead", self.name)
            answer = ">"
        if answer.startswith("x"):
            self._refuse("refused to emit")
        clock = self.link.clock
        end = clock.now() + EMISSION_S
        while Status.ON not in self.status() or not self.measured_mw() > 0.0:
            if clock.now() > end:
                self.require_ready()
                problem = f"did not emit within {EMISSION_S:g} s"
                raise self.link.error(NoAnswer, problem, "check key switch, interlock and enable pin")
            clock.sleep(POLL_S)
        self._subscriber(self.armed_mw)

    def darken(self) -> None:
        """Send LOf without waiting for anything, first of all when something is wrong; the CR ends what was begun."""
        self._owed.add("LOf")
        try:
            self.link.write(b"\r?LOf\r")
        finally:
            self._subscriber(0.0)

    def require_power(self, tolerance: float) -> float:
        """Its own reading in mW; refused where two in a row are not its set point within this share.

        Answers have no checksum: one garbled digit must not stop a scan.

        Raises: DeviceFault.
        """
        for _ in range(2):
            measured = self.measured_mw()
            if abs(measured - self.armed_mw) <= tolerance * self.armed_mw:
                return measured
        problem = f"emits {measured:.2f} mW instead of {self.armed_mw:g} mW (allowed: {100 * tolerance:g} % off)"
        raise self.link.error(DeviceFault, problem, "let it warm up longer, or have the laser serviced")

    def stop_emission(self) -> None:
        """Switch the light off; it takes seconds to come back. May be asked for at any time."""
        try:
            self._set("LOf")
        finally:
            self._subscriber(0.0)

    def reset(self) -> None:
        """Clear latched failures by a restart of the controller (seconds), and switch off. Raises: NoAnswer."""
        self._inbox.clear()
        self.framer.notices.clear()
        self.link.write(b"?RsC\r")
        clock = self.link.clock
        end = clock.now() + RESET_S
        while not any(notice.startswith("RsC") for notice in self.framer.notices):
            if clock.now() > end:
                problem = f"did not come back within {RESET_S:g} s after a reset"
                raise self.link.error(NoAnswer, problem, "switch the laser off and on")
            self._inbox.next(lambda _: False, POLL_S)
        self._owed.clear()
        self.force_off()

    def close(self) -> None:
        """Switch off as far as the laser still listens, and give the port back; Ctrl-C waits until then."""
        with uninterrupted():
            try:
                self.force_off()
            finally:
                self.link.close()

    def _set_power(self, share: float) -> None:
        """TPP (not stored), or SLP where TPP is unknown."""
        if self._temporary_power:
            try:
                self._set("TPP", f"{100.0 * share:.5f}")
                return
            except DeviceRefused as error:
                if "does not know" not in error.problem:
                    raise
                self._temporary_power = False
        self._store_level(round(share * LEVELS))

    def _store_level(self, level: int) -> None:
        """SLP: the same level twice is the same level, but wears the memory that keeps it.

        So it is written on change only, and not again after a lost answer: the level itself shows whether it was.
        """
        for _ in range(ATTEMPTS):
            if self._bits("GLP") == level:
                return
            try:
                answer = self._once("SLP", f"{level:03X}")
            except NoAnswer as error:
                log.warning("%s; asking for the level instead", error.without_remedy)
                continue
            if answer.startswith("x"):
                self._refuse(f"refused ?SLP{level:03X}")
        if self._bits("GLP") != level:
            problem = f"did not keep level {level:03X} in {ATTEMPTS} attempts"
            raise self.link.error(DeviceRefused, problem, "reset the laser, or switch it off and on")

    def _set_mode(self, add: int = 0, clear: int = 0) -> None:
        before = self.mode()
        wanted = (int(before) | add) & ~clear & 0xFFFF
        if wanted != before:
            self._set("SOM", f"{wanted:04X}")
        if self.mode() != wanted:
            problem = f"did not keep mode {wanted:04X}"
            raise self.link.error(DeviceRefused, problem, "reset the laser, or switch it off and on")


def _begins(*prefixes: str) -> Callable[[str], bool]:
    return lambda message: message.startswith(prefixes)


def _done_or_refused(answer: str) -> str:
    if answer[:1] not in (">", "x"):
        raise ValueError(answer)
    return answer[0]
