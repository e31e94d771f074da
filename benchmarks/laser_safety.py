"""How long does light go on after the program should have put it out? Measured in the emulated devices.

Every trial is a capture by a program of its own, with the real drivers and supervisor, through pseudo-terminals, in
real time, that ends by one of the events: connecting to a laser that somebody left on; the end of the program; an
exception; SIGINT, SIGTERM, SIGHUP, SIGQUIT; SIGKILL; SIGSTOP; the end of the program with a signal on its heels
(`closing`); SIGINT while one laser is mute. It is dark when no laser emits and gates and floodlight are off, sampled
every millisecond; the warning lamp has to be out 0.2 s later. All trials are made twice: alone, and beside four busy
processes (keys with `busy_`).

`worst_off_ms` counts from the event to darkness. It is the sum of ours, until the last command for darkness has left
the supervisor (`worst_told_ms`), and of the emulated devices' own time from then on (`worst_emulator_ms`), which real
devices spend in their firmware. `missed`: the program got as far as the event, and the light did not go out;
`not_reached`: it had ended before, or had not come so far in time. `notes` says of each of them what was lit, and what
the program said last. Every trial begins with dark devices. The emulated ones run before ordinary processes, where
the system allows it (`devices_first`): a laser's firmware does not wait for this computer's processors. Waits that have
nothing to do with it (emission, the board's boot, turns) are shortened.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np

import disco_twin.firmware.omicron as omicron_firmware
import disco_twin.firmware.turning as turning
import hw.devices.mm_ard as board_driver
from benchmarks.device_priority import come_first
from benchmarks.timed_supervisor import STAMPS
from disco_twin.emulation.bench import LAMP_LINE
from disco_twin.emulation.emulated_rig import Emulation
from disco_twin.emulation.rig_file_of import rig_file_of
from disco_twin.emulation.serve import Server
from disco_twin.emulation.served_rig import emulated_devices
from disco_twin.scene.rig_schema import TwinRigConfig
from hw.base.clock import WallClock
from hw.devices.omicron_protocol import Mode
from hw.interface import Aim
from hw.record import RawImage
from hw.rig.connect import Connector
from hw.rig.rig_rules import load_rig_file
from hw.rig.serial_rig import SerialRig
from hw.safety.ports import protocol_supervised
from hw.serial.link import Link
from pipeline.capture.loop import capture
from pipeline.geometry.nominal_rig import CameraConfig
from pipeline.plan.plan import Plan

SEED = 635532476
LANES = 2
BUSY = 4  # processes beside which all trials are made once more
LIMIT_S = 0.1
GIVEN_UP_S = 3.0
START_S = 60.0
CLOSING_S = 0.1  # within it comes the signal after a normal end
MUTE = 1  # the laser that falls silent
SIGNALS = {
    "mute": signal.SIGINT,
    **{n: signal.Signals[n] for n in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGKILL", "SIGSTOP")},
}
EVENTS = ("connect", "exit", "exception", "closing", *SIGNALS)
TRIALS = 200
RIG = TwinRigConfig(cameras=(CameraConfig(name="front", position_mm=(450, 60, 100), width=16, height=16),))
PLAN = Plan(("front",), (0.0,), tuple(Aim(0, 1800 + k, 2000) for k in range(400)), lasers=3)


# ---- the program, which ends


class Blink:
    """A camera that exposes for 20 ms, and ends the program at its last image."""

    name = "front"

    def __init__(self, how: str, images: int, told: Connection) -> None:
        self.how, self.left, self.told = how, images, told

    def expose(self) -> RawImage:
        """A dark image."""
        time.sleep(0.02)
        self.left -= 1
        if self.left == 0:
            self.told.send(time.monotonic())
            if self.how in ("exit", "closing"):
                sys.exit(0)
            if self.how == "exception":
                raise RuntimeError("the benchmark's exception")
        return RawImage(np.zeros((16, 16), np.uint8), np.zeros((16, 16), np.uint16))


def _prepare(out: Path) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    os.dup2(os.open(out.with_suffix(".err"), os.O_CREAT | os.O_WRONLY | os.O_APPEND), 2)  # its supervisor's, too
    board_driver.BOOT_S = 0.05
    os.environ[STAMPS] = str(out.with_suffix(".stamps"))
    protocol_supervised.MODULE = "benchmarks.timed_supervisor"


def program(rig_toml: Path, folder: Path, how: str, images: int, told: Connection) -> None:
    """A capture; says when it is under way (or, if it ends itself, when it does)."""
    _prepare(folder)
    rig = SerialRig(Connector(load_rig_file(rig_toml)), [Blink(how, images, told)], armed=True)
    capture(rig, PLAN, folder)


def connecting(url: str, out: Path, told: Connection) -> None:
    """Opens a laser's port, and does nothing else."""
    _prepare(out)
    link = Link(f"supervised://laser:{url}", 500000, "laser", WallClock())
    told.send(time.monotonic())
    link.close()


# ---- who watches


class Watch:
    """Samples all devices but the mute one; `last_on` is when any of them was on last."""

    def __init__(self, emulation: Emulation, mute: int | None) -> None:
        self.emulation, self.mute, self.last_on = emulation, mute, 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def on(self) -> bool:
        """Whether any gate is open, the floodlight is on, or any laser emits."""
        bench, now = self.emulation.bench, time.monotonic()
        emits = (head.emission(now) > 0 for k, head in enumerate(bench.heads) if k != self.mute)
        return bool(bench.board.lines & ~(1 << LAMP_LINE)) or any(emits)

    def _run(self) -> None:
        while not self._ended.wait(1e-3):
            if self.on:
                self.last_on = time.monotonic()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()


@dataclass(frozen=True)
class Trial:
    """off_ms: from the event to darkness, told_ms: to the last command for it; infinite if it did not come.

    reached: the program got as far as the event. ended_s: from the event to the end of the program. note: of one that
    did not reach it or did not go dark
    """

    event: str
    reached: bool
    off_ms: float = np.inf
    told_ms: float = np.inf
    ended_s: float = np.inf
    note: str = ""


def watched(numbers: Sequence[int]) -> tuple[list[Trial], list[str], bool]:
    """The trials of one lane, one after the other, what their bench saw that must never happen, `devices_first`."""
    omicron_firmware.EMISSION_S, turning.SPEED_DEG_S = 0.05, 720.0
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    forkserver.ensure_running()  # of the programs, at ordinary priority
    first = come_first()
    emulation = emulated_devices(RIG, seed=1)
    trials = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        lasers = {name: line for name, line in emulation.cables.items() if name.startswith("laser")}
        with Server(emulation.cables, folder) as ports:
            (folder / "rig.toml").write_text(rig_file_of(RIG, ports.urls))
            for number in numbers:
                event = EVENTS[number % len(EVENTS)]
                if event != "connect":
                    trials.append(_captured(context, emulation, folder, event, number))
        for number in numbers:
            if EVENTS[number % len(EVENTS)] == "connect":
                with Server(lasers, None) as sockets:
                    trials.append(_connected(context, emulation, sockets.urls, folder, number))
    return trials, emulation.bench.hazards, first


def _captured(context: Any, emulation: Emulation, folder: Path, event: str, number: int) -> Trial:
    """A capture that ends."""
    random = np.random.default_rng((SEED, number))
    images, out = int(random.integers(2, 8)), folder / f"out{number}"
    mute = MUTE if event == "mute" else None
    firmware = emulation.cables[f"laser{MUTE}"].firmware
    hear = firmware.feed
    ours, theirs = context.Pipe()
    _darken(emulation)
    watch = Watch(emulation, mute)
    child = context.Process(target=program, args=(folder / "rig.toml", out, event, images, theirs))
    child.start()
    try:
        wait([ours, child.sentinel], START_S)
        if not ours.poll():
            return Trial(event, reached=False, note=_note(watch, out, child))
        happened = float(ours.recv())
        if event in SIGNALS:
            time.sleep(float(random.uniform(0, 0.3)))
            if not watch.on:
                return Trial(event, reached=False, note=_note(watch, out, child))
            if mute is not None:
                setattr(firmware, "feed", lambda data, now: [])  # noqa: B010 - one laser falls silent
            happened = time.monotonic()
            os.kill(child.pid, SIGNALS[event])
        elif event == "closing":
            time.sleep(float(random.uniform(0, CLOSING_S)))
            ending = [SIGNALS[name] for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")]
            os.kill(child.pid, int(random.choice(ending)))
        off_ms, ended_s = _until_dark(watch, happened), np.inf
        if event != "SIGSTOP":
            child.join(10.0)
            ended_s = time.monotonic() - happened
        told_ms = _told(out.with_suffix(".stamps"), happened, None if mute is None else f"laser{mute}")
        return Trial(event, True, off_ms, told_ms, ended_s, "" if np.isfinite(off_ms) else _note(watch, out, child))
    finally:
        setattr(firmware, "feed", hear)  # noqa: B010
        _end(child)
        watch.close()


def _connected(context: Any, emulation: Emulation, urls: dict[str, str], folder: Path, number: int) -> Trial:
    """The port of a laser that is on is opened (a socket, which knows when that is)."""
    name = f"laser{number // len(EVENTS) % len(emulation.bench.heads)}"
    line, head = emulation.cables[name], emulation.bench.heads[int(name[-1])]
    opened: list[float] = []
    before = line.opened

    def spy() -> None:
        opened.append(time.monotonic())
        before()

    _darken(emulation)
    head.on_since, head.level, head.mode = time.monotonic() - 60, 1.0, int(Mode.BIAS | Mode.RELEASE)
    setattr(line, "opened", spy)  # noqa: B010 - a spy on one line
    ours, theirs = context.Pipe()
    watch, out = Watch(emulation, None), folder / f"connect{number}"
    child = context.Process(target=connecting, args=(urls[name], out, theirs))
    child.start()
    try:
        wait([ours, child.sentinel], START_S)
        if not ours.poll() or not opened:
            return Trial("connect", reached=False, note=_note(watch, out, child))
        off_ms = _until_dark(watch, opened[0])
        told_ms = max(0.0, _told(out.with_suffix(".stamps"), opened[0] - 1.0) - 1e3)
        return Trial("connect", True, off_ms, told_ms, note="" if np.isfinite(off_ms) else _note(watch, out, child))
    finally:
        setattr(line, "opened", before)  # noqa: B010
        child.join(10.0)  # it closes the port
        _end(child)
        watch.close()


def _darken(emulation: Emulation) -> None:
    """What an earlier trial left lit is no matter of the next one's."""
    emulation.bench.board.set_pattern(0)
    for head in emulation.bench.heads:
        head.on_since = None


def _note(watch: Watch, out: Path, child: BaseProcess) -> str:
    """What is lit, how the program is, and what it or its supervisor said last."""
    bench, now = watch.emulation.bench, time.monotonic()
    lit = [f"laser{k}" for k, head in enumerate(bench.heads) if head.on_since is not None]
    said = out.with_suffix(".err").read_text(errors="replace").splitlines() if out.with_suffix(".err").exists() else []
    state = "runs" if child.is_alive() else f"ended with {child.exitcode}"
    return f"lit: {lit}, lines {bench.board.lines:#b}, {now - watch.last_on:.1f} s ago; {state}; said {said[-2:]}"


def _told(stamps: Path, happened: float, but: str | None = None) -> float:
    """Milliseconds until every device had been told to be dark, `but` one."""
    first: dict[str, float] = {}
    for row in stamps.read_text().splitlines():
        at, url = row.split(" ", 1)
        if float(at) >= happened and (but is None or not url.endswith(but)):
            first.setdefault(url, 1e3 * (float(at) - happened))
    return max(first.values(), default=np.inf)


def _until_dark(watch: Watch, happened: float) -> float:
    """Milliseconds; infinite if it is not dark in time, or not dark for long."""
    while watch.on:
        if time.monotonic() > happened + GIVEN_UP_S:
            return np.inf
        time.sleep(1e-3)
    time.sleep(0.2)
    return np.inf if watch.on or watch.emulation.bench.board.lines else 1e3 * max(0.0, watch.last_on - happened)


def _end(child: BaseProcess) -> None:
    child.join(0.0)
    if child.is_alive():
        child.kill()
    child.join()


# ---- figures


def _compute(parent: int) -> None:
    while os.getppid() == parent:
        sum(range(100_000))


@contextmanager
def busy(count: int) -> Iterator[None]:
    """So many processes that compute."""
    others = [multiprocessing.get_context("fork").Process(target=_compute, args=(os.getpid(),)) for _ in range(count)]
    for other in others:
        other.start()
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.join()


def figures(count: int, others: int) -> dict[str, Any]:
    """So many trials beside so many busy processes."""
    lanes = [range(lane, count, LANES) for lane in range(LANES)]
    load = os.getloadavg()[0]
    with busy(others), ProcessPoolExecutor(LANES, mp_context=multiprocessing.get_context("spawn")) as pool:
        seen = list(pool.map(watched, lanes))
    trials = [trial for lane, _, _ in seen for trial in lane]
    dark = [trial for trial in trials if np.isfinite(trial.off_ms)]
    rows = []
    for event in EVENTS:
        own = [trial for trial in dark if trial.event == event]
        ended = [trial.ended_s for trial in own if np.isfinite(trial.ended_s)]
        rows.append({
            "event": event,
            "beside": others,
            "trials": sum(trial.event == event for trial in trials),
            "median_ms": statistics.median([t.off_ms for t in own]) if own else 0.0,
            "worst_ms": max((t.off_ms for t in own), default=0.0),
            "worst_told_ms": max((t.told_ms for t in own), default=0.0),
            "worst_emulator_ms": max((max(0.0, t.off_ms - t.told_ms) for t in own), default=0.0),
            "worst_end_s": max(ended, default=0.0),
        })  # fmt: skip
    return {
        "trials": len(trials),
        "worst_off_ms": max((t.off_ms for t in dark), default=0.0),
        "worst_told_ms": max((t.told_ms for t in dark), default=0.0),
        "worst_emulator_ms": max((max(0.0, t.off_ms - t.told_ms) for t in dark), default=0.0),
        "missed": sum(t.reached and not np.isfinite(t.off_ms) for t in trials),
        "not_reached": sum(not t.reached for t in trials),
        "notes": [f"{t.event}: {'missed' if t.reached else 'not reached'}: {t.note}" for t in trials if t.note],
        "over_limit": sum(t.off_ms > 1e3 * LIMIT_S for t in dark),
        "ctrl_c_end_s": max((t.ended_s for t in dark if t.event in ("SIGINT", "mute")), default=0.0),
        "load_before": load,
        "hazards": [hazard for _, found, _ in seen for hazard in found],
        "devices_first": all(first for _, _, first in seen),
        "rows": rows,
    }


def run(quick: bool) -> dict[str, Any]:
    """200 trials alone and 200 beside four busy processes; two rounds of all events, and one, if quick."""
    alone = figures(2 * len(EVENTS) if quick else TRIALS, 0)
    beside = figures(len(EVENTS) if quick else TRIALS, BUSY)
    rows = [*alone.pop("rows"), *beside.pop("rows")]
    return alone | {f"busy_{key}": value for key, value in beside.items()} | {"rows": rows}
