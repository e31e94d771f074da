"""Random faults in a capture through the emulated serial rig: is every image there, and right?

Every run is one capture of 300 images with one fault at a random moment: a reply that is lost, late, split or garbled,
a garbled command, a stall of the turntable, an open interlock, a turned key, a cable that is pulled, a device that
loses power, the program killed by SIGKILL. Where the capture stops, the rig must be dark and the reason must say what
to do; an operator mends the cause and repeats the command, which re-homes, verifies laser power and shoots the
reference spot again. In the end the stream is compared, bit for bit, with that of an undisturbed capture.

Time is virtual: devices take as long as real ones, nobody waits. A killed program's devices stay in the state in which
it left them.
"""

from __future__ import annotations

import os
import pickle
import re
import signal
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disco_twin.camera.lars3 import lars3_sensor
from disco_twin.emulation.emulated_rig import Emulation
from disco_twin.emulation.twin_rig import TwinRig
from disco_twin.firmware import wire
from disco_twin.scene.rig_schema import TwinRigConfig
from hw.base.clock import VirtualClock
from hw.base.errors import DiscoError
from hw.interface import Aim
from pipeline.capture.loop import capture
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.plan.plan import Plan
from pipeline.stream.stream import CorruptImage, StreamReader

SEED = 20040814
SIZE = (31, 48)
ATTEMPTS = 6  # a command that is repeated more often than this, after one fault, has hung
PATIENCE = 10.0  # of the undisturbed capture's (virtual) time

RIG = TwinRigConfig(
    cameras=tuple(
        CameraConfig(name=name, position_mm=(x, 60, 100), width=SIZE[1], height=SIZE[0], focal_length_mm=10)
        for name, x in (("front", 450), ("back", -450))
    ),
    turntable_angles_deg=(0.0, 120.0, 240.0),
)
SPOTS = 49  # 2 cameras x 3 angles: 6 silhouettes and 2 x 3 lasers x 49 spots, 300 images


class Glow:
    """A response source: an exponential spot on a textured object, at the angle and place of the aim."""

    size, scale = SIZE, 1.0  # pixels, and how many of them are one of the small images'

    def prepare(self, aims: Sequence[Aim]) -> None:
        """Nothing to work ahead."""

    def image(self, camera: int, aim: Aim, laser: int) -> NDArray[np.float32]:
        """(H, W) radiance per watt."""
        row, column = np.mgrid[: self.size[0], : self.size[1]] / self.scale
        distance = np.hypot(row - 15 - (aim.v - 2048) / 40, column - 24 - (aim.u - 2048) / 20)
        texture = 1 + 0.2 * np.sin(column / 3 + aim.angle) * np.cos(row / 4 + camera)
        return np.asarray(0.03 * texture * np.exp(-distance / (2 + laser + camera)), np.float32)

    def silhouette(self, camera: int, angle: int) -> NDArray[np.float32]:
        """(H, W) radiance."""
        return np.full(self.size, 1e-6 * (1 + camera + angle), np.float32)


def plan() -> Plan:
    """300 images."""
    random = np.random.default_rng(SEED)
    steps = random.integers(1850, 2250, (SPOTS, 2))
    aims = tuple(Aim(k * 3 // SPOTS, int(u), int(v)) for k, (u, v) in enumerate(steps))
    return Plan(("front", "back"), tuple(np.deg2rad(RIG.turntable_angles_deg).tolist()), aims, lasers=3)


class Hung(Exception):
    """A capture that takes many times as long as the undisturbed one."""


class Timetable(VirtualClock):
    """A virtual clock on which something happens at a given time."""

    def __init__(self, start: float = 0.0) -> None:
        super().__init__(start)
        self.at, self.event, self.limit = np.inf, _nothing, np.inf

    def sleep(self, seconds: float) -> None:
        """Let the event happen on the way."""
        end = self.now() + max(0.0, seconds)
        if self.at <= end:
            super().sleep(self.at - self.now())
            self.at, event = np.inf, self.event
            event()
        if end > self.limit:
            raise Hung(f"after {end:.0f} s of virtual time")
        super().sleep(end - self.now())


def _nothing() -> None:
    """No event."""


@dataclass(frozen=True)
class Fault:
    """What goes wrong. `when` of the undisturbed capture's time or, for what befalls one message, of its messages."""

    kind: str
    line: str
    when: float
    detail: float


MESSAGE_KINDS = ("lost", "late", "split", "garbled", "garbled command")
DEVICE_KINDS = ("unplug", "power", "kill")
KINDS = (*MESSAGE_KINDS, *DEVICE_KINDS, "stall", "interlock", "key")


def draw(number: int, lines: Sequence[str]) -> Fault:
    """The faults in turn, their place and time at random."""
    random = np.random.default_rng((SEED, number))
    kind = KINDS[number % len(KINDS)]
    line = str(random.choice(lines))
    if kind == "stall":
        line = "turntable"
    elif kind in ("interlock", "key"):
        line = f"laser{random.integers(3)}"
    return Fault(kind, line, float(random.random()), float(random.random()))


@dataclass(frozen=True)
class Undisturbed:
    """The capture without faults: its folder, its (virtual) seconds, and the messages of every line."""

    folder: Path
    seconds: float
    messages: dict[str, int]


def undisturbed(folder: Path) -> Undisturbed:
    """Make it."""
    clock = Timetable()
    emulation = Emulation(TwinRig(RIG, Glow(), SEED), clock)
    sent: Counter[str] = Counter()
    for name, line in emulation.cables.items():
        setattr(line, "receive", counting(line.receive, name, sent))  # noqa: B010 - a spy on one line
    capture(emulation.serial_rig(), plan(), folder)
    assert emulation.bench.hazards == []
    return Undisturbed(folder, clock.now(), dict(sent))


def counting(receive: Callable[[bytes], None], name: str, sent: Counter[str]) -> Callable[[bytes], None]:
    def counted(data: bytes) -> None:
        sent[name] += 1
        receive(data)

    return counted


def arm(fault: Fault, emulation: Emulation, whole: Undisturbed, state: Path) -> None:
    """Prepare the fault."""
    line, clock = emulation.cables[fault.line], emulation.clock
    assert isinstance(clock, Timetable)
    if fault.kind in MESSAGE_KINDS:
        before = int(fault.when * whole.messages[fault.line])
        byte = int(fault.detail * 16)
        befalls: dict[str, Any] = {
            "lost": wire.lost,
            "late": wire.late(0.1 + 2.0 * fault.detail),
            "split": wire.split(1 + byte % 3, 0.3 * fault.detail),
            "garbled": wire.garbled(byte, 1 << byte % 7),
            "garbled command": lambda data: bytes([data[0] ^ 1 << byte % 7]) + data[1:],
        }
        queue: Any = line.command_faults if fault.kind == "garbled command" else line.answer_faults
        queue.extend([*[None] * before, befalls[fault.kind]])
        return
    clock.at = fault.when * whole.seconds
    index = int(fault.line[-1]) if fault.line.startswith("laser") else 0
    head = emulation.bench.heads[index]
    events: dict[str, Callable[[], None]] = {
        "unplug": line.unplug,
        "power": line.power_cycle,
        "kill": lambda: _die(emulation, state),
        "stall": lambda: setattr(emulation.bench.spindle, "sticks_at_deg", 20.0 + 320.0 * fault.detail),
        "interlock": lambda: head.set_interlock(False),
        "key": lambda: head.set_key(False),
    }
    clock.event = events[fault.kind]


def _die(emulation: Emulation, state: Path) -> None:
    """SIGKILL; what the devices are doing at this moment is left behind for those who come after."""
    bench = emulation.bench
    bare = [dict(vars(device)) for device in (*bench.heads, bench.board, bench.spindle)]
    for fields in bare:
        for name in ("sample", "on_move", "on_lines", "on_start"):
            fields.pop(name, None)
    state.write_bytes(pickle.dumps((emulation.clock.now(), bare)))
    os.kill(os.getpid(), signal.SIGKILL)


def revived(state: Path) -> Emulation:
    """The devices as a killed program left them."""
    now, bare = pickle.loads(state.read_bytes())
    emulation = Emulation(TwinRig(RIG, Glow(), SEED), Timetable(now))
    bench = emulation.bench
    for device, fields in zip((*bench.heads, bench.board, bench.spindle), bare, strict=True):
        vars(device).update(fields)
    return emulation


def mend(emulation: Emulation) -> None:
    """What an operator does: plug in, close the interlock, turn the key on, restart what reports a fault."""
    for line in emulation.cables.values():
        line.plug()
        line.answer_faults.clear()
        line.command_faults.clear()
    for index, head in enumerate(emulation.bench.heads):
        if head.failures or not head.key:
            head.set_interlock(True)
            head.set_key(True)
            emulation.cables[f"laser{index}"].power_cycle()


@dataclass(frozen=True)
class Outcome:
    """One run. stops: the reasons, in the order of the attempts; problems: what must not be."""

    fault: Fault
    stops: tuple[str, ...]
    problems: tuple[str, ...]
    hung: bool
    lost: int
    wrong: int


def run_one(fault: Fault, whole: Undisturbed, folder: Path) -> Outcome:
    """One capture with one fault, repeated by the operator until it is complete."""
    state = folder.with_suffix(".state")
    stops: list[str] = []
    problems: list[str] = []
    if fault.kind == "kill":
        _in_a_child(fault, whole, folder, state)
        emulation = revived(state)
        stops.append("killed")
    else:
        emulation = Emulation(TwinRig(RIG, Glow(), SEED), Timetable())
        arm(fault, emulation, whole, state)
    assert isinstance(emulation.clock, Timetable)
    emulation.clock.limit = emulation.clock.now() + PATIENCE * whole.seconds
    hung = False
    for _ in range(ATTEMPTS):
        try:
            capture(emulation.serial_rig(), plan(), folder, sensor=lars3_sensor(RIG))
            break
        except DiscoError as error:
            stops.append(str(error))
            if "Remedy" not in str(error):
                problems.append(f"no remedy: {error}")
            problems += _not_dark(emulation)
            mend(emulation)
        except Hung as error:
            problems.append(str(error))
            hung = True
            break
    else:
        hung = True
        problems.append(f"stopped {ATTEMPTS} times")
    problems += _not_dark(emulation) + emulation.bench.hazards
    lost, wrong = differences(whole.folder, folder)
    return Outcome(fault, tuple(stops), tuple(problems), hung, lost, wrong)


def _in_a_child(fault: Fault, whole: Undisturbed, folder: Path, state: Path) -> None:
    """The capture in a process that dies in it."""
    child = os.fork()
    if child == 0:
        try:
            emulation = Emulation(TwinRig(RIG, Glow(), SEED), Timetable())
            arm(fault, emulation, whole, state)
            capture(emulation.serial_rig(), plan(), folder, sensor=lars3_sensor(RIG))
        finally:
            os._exit(0)
    os.waitpid(child, 0)


def _not_dark(emulation: Emulation) -> list[str]:
    """What still shines after the program has stopped. A laser without a cable cannot hear: its gate must be shut."""
    bench, now = emulation.bench, emulation.clock.now()
    left = [f"laser {i} falls on the object" for i in bench.light()]
    for index, head in enumerate(bench.heads):
        if emulation.cables[f"laser{index}"].plugged and head.emission(now) > 0:
            left.append(f"laser {index} emits")
    return left


def differences(whole: Path, folder: Path) -> tuple[int, int]:
    """Images that are missing, and images whose pixels or record differ from the undisturbed ones."""
    with StreamReader(whole) as expected, StreamReader(folder) as found:
        wrong = 0
        for index in range(len(found)):
            try:
                a, b = expected.read(index), found.read(index)
            except CorruptImage:
                wrong += 1
                continue
            same = np.array_equal(a.charge, b.charge) and np.array_equal(a.exponent, b.exponent)
            wrong += not (same and expected.meta(index) == found.meta(index))
        return len(expected) - len(found), wrong


def _reasons(outcomes: Sequence[Outcome]) -> Counter[str]:
    """Why runs stopped; ports have other numbers in every run."""
    first = (outcome.stops[0].split(". Remedy")[0] for outcome in outcomes if outcome.stops)
    return Counter(re.sub(r"emulated-\d+-", "", reason) for reason in first)


def run(quick: bool) -> dict[str, Any]:
    """Two hundred faults; 22 if quick."""
    runs = 2 * len(KINDS) if quick else 200
    with tempfile.TemporaryDirectory() as scratch:
        whole = undisturbed(Path(scratch, "whole"))
        lines = sorted(whole.messages)
        outcomes = [run_one(draw(n, lines), whole, Path(scratch, f"run{n}")) for n in range(runs)]
    good = [o for o in outcomes if not o.problems and not o.lost and not o.wrong]
    return {
        "runs": runs,
        "images": len(plan()),
        "complete": sum(not o.stops for o in good),
        "stopped_safely": sum(bool(o.stops) for o in good),
        "images_lost": sum(o.lost for o in outcomes),
        "images_wrong": sum(o.wrong for o in outcomes),
        "hung": sum(o.hung for o in outcomes),
        "virtual_seconds": whole.seconds,
        "by_kind": {
            kind: {
                "runs": sum(o.fault.kind == kind for o in outcomes),
                "complete": sum(o.fault.kind == kind and not o.stops for o in good),
                "stopped_safely": sum(o.fault.kind == kind and bool(o.stops) for o in good),
            }
            for kind in KINDS
        },
        "problems": [{"fault": str(o.fault), "what": "; ".join(o.problems)} for o in outcomes if o not in good],
        "reasons": [{"reason": reason, "runs": runs} for reason, runs in _reasons(outcomes).most_common()],
    }
